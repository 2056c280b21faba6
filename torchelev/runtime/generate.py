"""Write the headers of the C library that follow from Python's declarations: `python -m torchelev.runtime.generate`."""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from torchelev.config import ElevationMapConfig, setting_types
from torchelev.diagnosis import history, sensor_bias, surfaces
from torchelev.diagnosis.causes import REASONS
from torchelev.diagnosis.evidence import FAR, GATES, MIN_POINTS
from torchelev.files.config_files import VERSION
from torchelev.filters.inpainting import harmonic
from torchelev.filters.registry import FILTERS, settings_of
from torchelev.grid import MIN_RESOLUTION
from torchelev.inputs.checks import FARTHEST
from torchelev.kernels.cpu_update import Inputs
from torchelev.kernels.registry import header
from torchelev.kernels.structs import Double, members
from torchelev.levels.config import MAX_HEIGHT, MAX_LEVELS, SEPARATIONS
from torchelev.observations.ground import MARGIN, MAX_BLOCK
from torchelev.observations.height_scan import HeightScan
from torchelev.observations.scan import presets
from torchelev.pipeline import KERNELS, ORDER, ORDER_WITH_LEVELS, TENSORS
from torchelev.plane_fit import MAX_RADIUS
from torchelev.robot import RobotConfig
from torchelev.robot_body.shapes import RobotBody
from torchelev.stages.by_tensors import ByTensors
from torchelev.stages.fusion.config import MAX_REFINEMENTS
from torchelev.stages.visibility.accepted_rays import NEAR
from torchelev.stages.visibility.config import MAX_CELLS
from torchelev.stages.visibility.polar_table import BREADTH
from torchelev.state import BLANK, MapState, Statistics
from torchelev.traversability.heads import STEP_REACH, LearnedTraversabilityConfig

FOLDER = Path(__file__).parent / "generated"
_NOTE = "// Written by `python -m torchelev.runtime.generate`.\n"
_ONLY_PYTHON = (RobotBody, LearnedTraversabilityConfig)  # settings of these types need Python
_PLANNING = (RobotConfig,)  # settings that no update reads
# The filters of the library that have settings: `KINDS` in source/filters/kinds.cpp.
_FILTERS = ("box", "gaussian", "inpaint_diffusion", "inpaint_minimum", "median")
_CHOICES = {"separation": SEPARATIONS}  # words of settings
_DTYPES = {"float": "F32", "int64_t": "I64", "uint8_t": "U8"}  # of safetensors


#: of Python, beside those in the settings: type in C++, name, value
_CONSTANTS: tuple[tuple[str, str, float], ...] = (
    ("int", "CONFIG_VERSION", VERSION),
    ("int", "MAX_RADIUS", MAX_RADIUS),  # [cells]
    ("int", "MAX_REFINEMENTS", MAX_REFINEMENTS),
    ("int", "MAX_CELLS", MAX_CELLS),  # of a ray
    ("int", "MAX_LEVELS", MAX_LEVELS),
    ("double", "MAX_HEIGHT", MAX_HEIGHT),  # [m] of a gap or a step of levels
    ("double", "MIN_RESOLUTION", MIN_RESOLUTION),  # [m]
    ("double", "FARTHEST", FARTHEST),  # [m]
    ("double", "STEP_REACH", STEP_REACH),  # [m]
    ("double", "NEAR", NEAR),  # [m]
    ("double", "BREADTH", BREADTH),  # [cells]
    ("double", "MARGIN", MARGIN),  # [m]
    ("double", "MAX_BLOCK", MAX_BLOCK),  # [m]
    ("double", "DAMPING", harmonic.DAMPING),
    ("double", "OVERCORRECTION", harmonic.OVERCORRECTION),
    ("double", "SAFETY", harmonic.SAFETY),
)

_OF_DIAGNOSIS = (
    ("int", "MAX_UPDATES", history.MAX_UPDATES),
    ("int", "MAX_CORRECTIONS", history.MAX_CORRECTIONS),
    ("int", "MAX_POINTS", history.MAX_POINTS),  # of a sensor
    ("int", "PERIOD", history.PERIOD),  # [updates]
    ("int", "MIN_POINTS", MIN_POINTS),
    ("double", "FAR", FAR),  # [m]
    ("double", "MIN_BIAS", sensor_bias.MIN_BIAS),  # [m]
    ("int", "MAX_TURNS", sensor_bias.MAX_SENSORS),
    ("int", "MIN_TURNS", sensor_bias.MIN_TURNS),
    ("double", "MIN_EXPLAINED", sensor_bias.MIN_EXPLAINED),
    ("double", "CELL_SIZE", surfaces.CELL_SIZE),  # [m]
    ("int", "MIN_IN_CELL", surfaces.MIN_IN_CELL),
    ("double", "SPREAD", surfaces.SPREAD),  # [m]
)


def headers() -> dict[str, str]:
    """Return the headers' texts by name."""
    structs = header(KERNELS, ElevationMapConfig(), [*TENSORS, ("Inputs", Inputs, {})])
    return {"generated.h": _NOTE + structs, "tables.h": _tables()}


def _tables() -> str:
    return "\n".join(
        [
            _NOTE + '#pragma once\n\n#include "runtime/source/table_types.h"\n',
            _table("Setting", "SETTINGS", _settings(ElevationMapConfig(), "")),
            _table("Choice", "CHOICES", _choices()),
            _table("Tensor", "STATE", _tensors()),
            _constants(_CONSTANTS),
            _in_namespace(
                "diagnosis",
                _constants(_OF_DIAGNOSIS)
                + _table("Gate", "GATES", (f'{{"{name}", "{REASONS[name]}"}}' for name in GATES)),
            ),
            _table("FilterSetting", "FILTER_SETTINGS", _filter_settings()),
            _table("const char*", "ALL_FILTERS", (f'"{name}"' for name in sorted(FILTERS) if _is_ours(name))),
            _default_settings(),
            _order(),
            *(_axes(name) for name in presets.PRESETS),
            _table("Preset", "PRESETS", map(_preset, presets.PRESETS)),
        ]
    )


def _table(kind: str, name: str, rows: Any) -> str:
    lines = ",\n".join(f"    {row}" for row in rows)
    return f"constexpr {kind} {name}[] = {{\n{lines},\n}};\n"


def _constants(constants: Iterable[tuple[str, str, float]]) -> str:
    return "".join(f"constexpr {kind} {name} = {_number(value)};\n" for kind, name, value in constants)


def _in_namespace(name: str, text: str) -> str:
    return f"namespace {name} {{\n\n{text}\n}}  // namespace {name}\n"


def _number(value: float) -> str:
    """Return a number in C++."""
    if isinstance(value, float) and math.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(float(value)) if isinstance(value, float) else str(int(value))


# Settings -----------------------------------------------------------------------------------------------------------


def _settings(cfg: Any, prefix: str) -> Iterator[str]:
    """Yield a row for each setting below a config's group, the groups included, before what they hold."""
    cls: Any = type(cfg)
    for name, hint in setting_types(cls).items():
        kinds = [kind for kind in (typing.get_args(hint) or (hint,)) if kind is not type(None)]
        nullable = type(None) in typing.get_args(hint)
        value, path = getattr(cfg, name), prefix + name
        kind = _kind(name, kinds)
        yield _setting(path, kind, nullable, value)
        if kind == "GROUP":
            group = next(k for k in kinds if k not in _ONLY_PYTHON)
            yield from _settings(group() if value is None else value, f"{path}.")


def _kind(name: str, kinds: list[Any]) -> str:
    if name == "filters":
        return "CHAIN"
    if name == "channels" or any(isinstance(k, type) and issubclass(k, ByTensors) for k in kinds):
        return "ONLY_PYTHON"
    if name in _CHOICES:
        return "CHOICE"
    if any(kind in _PLANNING for kind in kinds):
        return "IGNORED"
    if any(dataclasses.is_dataclass(kind) for kind in kinds):
        return "GROUP"
    if typing.get_origin(kinds[0]) is tuple or len(kinds) == 3:
        return "PLACE"
    return "INTEGER" if kinds == [int] else "NUMBER"


def _setting(path: str, kind: str, nullable: bool, value: Any) -> str:
    numbers = value if kind == "PLACE" else (value,) if kind in ("NUMBER", "INTEGER") else ()
    if kind == "CHOICE":
        numbers = (_CHOICES[path.split(".")[-1]].index(value),)
    texts = ", ".join(_number(number) for number in numbers if number is not None)
    return f'{{"{path}", {kind}, {str(nullable).lower()}, {str(value is None).lower()}, {{{texts}}}}}'


def _choices() -> Iterator[str]:
    """Yield a row for each word of each setting that is one of several."""
    for name, words in _CHOICES.items():
        yield from (f'{{"{name}", "{word}"}}' for word in words)


def _default_settings() -> str:
    """Return a function that makes the C settings of the default config, the constants of all stages among them."""
    lines = []
    for kernel in KERNELS:
        for name, value in kernel.settings(ElevationMapConfig()).items():
            values = value if isinstance(value, tuple) else (value,)
            for k, number in enumerate(values):
                place = f"{kernel.name}.{name}" + (f"[{k}]" if isinstance(value, tuple) else "")
                text = _number(number)
                is_float = isinstance(number, float) and not isinstance(number, Double)
                lines.append(f"    s.{place} = {f'float({text})' if is_float else text};")
    body = "\n".join(lines)
    return f"inline Settings default_settings() {{\n    Settings s{{}};\n{body}\n    return s;\n}}\n"


# Filters ------------------------------------------------------------------------------------------------------------


def _filter_settings() -> Iterator[str]:
    """Yield a row for each setting of the library's filters, with its default."""
    for name in _FILTERS:
        for setting, parameter in settings_of(name).items():
            usual = "NAN" if parameter.default is None else _number(parameter.default)
            yield f'{{"{name}", "{setting}", {usual}}}'


def _is_ours(name: str) -> bool:
    """Return whether a filter is no user's."""
    return FILTERS[name].__module__.startswith("torchelev.")


# Tensors and stages -------------------------------------------------------------------------------------------------


def _tensors() -> Iterator[str]:
    """Yield a row for each tensor of a map, in the order of `MapState`'s struct."""
    named = [*((m.name, m) for m in members(MapState)), *((f"last_{m.name}", m) for m in members(Statistics))]
    for name, member in named:
        shape = [size if size.isdigit() else f"-'{size}'" for size in member.shape[1:]]
        sizes = ", ".join({"-'H'": "ROWS", "-'W'": "COLUMNS"}.get(size, size) for size in shape)
        blank = _number(float(BLANK.get(name, 0)))
        kind = "BOOL" if "Bool" in str(_annotation(name)) else _DTYPES[member.type]
        yield f'{{"{name}", "{kind}", sizeof({member.type}), {{{sizes}}}, {blank}}}'


def _annotation(name: str) -> Any:
    return MapState.__annotations__.get(name, "")


def _order() -> str:
    declared = "\n".join(f"void run_{name}(Update&);" for name in ORDER_WITH_LEVELS)
    orders = ("ORDER", ORDER), ("ORDER_WITH_LEVELS", ORDER_WITH_LEVELS)
    lists = "".join(_table("Stage", name, (f"run_{stage}" for stage in order)) for name, order in orders)
    return f'extern "C" {{\n{declared}\n}}\n{lists}'


# Height scans -------------------------------------------------------------------------------------------------------


def _axes(name: str) -> str:
    points = HeightScan.preset(name).pattern
    axes = (tuple(dict.fromkeys(point[axis] for point in points)) for axis in (0, 1))
    rows = (f"{name.upper()}_{axis}[] = {{{', '.join(map(_number, a))}}}" for axis, a in zip("XY", axes, strict=True))
    return "".join(f"constexpr double {row};\n" for row in rows)


def _preset(name: str) -> str:
    scan = HeightScan.preset(name)
    x_fastest = scan.pattern[0][1] == scan.pattern[1][1]
    mode = scan.mode.upper()
    numbers = [scan.nominal_height, math.inf if scan.clip is None else scan.clip, scan.scale]
    numbers.append(scan.nominal_height if scan.standing_height is None else scan.standing_height)
    texts = ", ".join(_number(float(number)) for number in numbers)
    axes = ", ".join(f"{name.upper()}_{a}, int(std::size({name.upper()}_{a}))" for a in "XY")
    return f'{{"{name}", {axes}, {str(x_fastest).lower()}, scans::{mode}, {texts}}}'


def main() -> None:
    """Write the headers."""
    FOLDER.mkdir(exist_ok=True)
    for name, text in headers().items():
        (FOLDER / name).write_text(text)


if __name__ == "__main__":
    main()
