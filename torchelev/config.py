"""The configuration of a map: one frozen dataclass per stage, each defined beside its stage."""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchelev.channels.config import ChannelConfigs, parse_channels
from torchelev.errors import require
from torchelev.files.config_files import from_json, read_settings, split_off_completion, without_header, write_settings
from torchelev.grid import GridConfig
from torchelev.layers import LAYERS
from torchelev.levels.config import LevelsConfig
from torchelev.stages.age.config import AgingConfig
from torchelev.stages.compensate.config import DriftConfig
from torchelev.stages.fusion.config import FusionConfig
from torchelev.stages.like_em_cupy import settings_like_em_cupy
from torchelev.stages.measure.config import SensorConfig
from torchelev.stages.overlap.config import OverlapConfig
from torchelev.stages.surface.config import SurfaceConfig
from torchelev.stages.visibility.config import RaycastConfig
from torchelev.traversability.heads import LearnedTraversabilityConfig, TraversabilityConfig

if TYPE_CHECKING:
    from torchelev.filters.chain import FilterConfig


@dataclass(frozen=True, kw_only=True)
class ElevationMapConfig:
    """Configuration of all stages of a map.

    `drift`, `raycast`, `overlap`, `traversability`, `levels` and `fusion.edges` can be None, which
    switches that stage off.

    Raises:
        TypeError: if a field has the wrong type.
        ValueError: if a setting is out of range.
    """

    grid: GridConfig = field(default_factory=GridConfig)  #: size of the window and of its cells
    sensor: SensorConfig = field(default_factory=SensorConfig)  #: noise, range, exclusion area, and the robot's body
    aging: AgingConfig = field(default_factory=AgingConfig)  #: process noise
    #: compensation of height drift; None switches it off
    drift: DriftConfig | None = field(default_factory=DriftConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)  #: Kalman update and outlier gate
    #: visibility clean-up and upper bound; None switches them off
    raycast: RaycastConfig | None = field(default_factory=RaycastConfig)
    #: overlap clearance; None switches it off
    overlap: OverlapConfig | None = field(default_factory=OverlapConfig)
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)  #: window for fitting the planes of the normals
    #: analytic head, or learned head for a legged robot; None: no traversability
    traversability: TraversabilityConfig | LearnedTraversabilityConfig | None = field(
        default_factory=TraversabilityConfig
    )
    levels: LevelsConfig | None = None  #: surfaces besides the ground, such as ceilings; None: one height per cell
    filters: tuple[FilterConfig, ...] = ()  #: additional layers, computed on reading: see `torchelev.filters`
    #: further values of each cell by name: a `ChannelConfig`, or the name of a kind for its defaults
    channels: Mapping[str, Any] = field(default_factory=ChannelConfigs)

    def __post_init__(self) -> None:
        if isinstance(self.filters, list):
            object.__setattr__(self, "filters", tuple(self.filters))
        hint = "give (FilterConfig(layer=..., filter=...), ...)"
        is_chain = _is_chain(self.filters)
        require(is_chain, "cfg.filters", "must be a tuple of FilterConfig", repr(self.filters), hint, TypeError)
        taken = (*LAYERS, *(step.layer for step in self.filters))
        object.__setattr__(self, "channels", parse_channels(self.channels, taken))
        for name, annotation in setting_types(type(self)).items():  # type: ignore[arg-type]
            if name in ("filters", "channels"):
                continue
            value, kinds = getattr(self, name), typing.get_args(annotation) or (annotation,)
            rule = f"must be {' or '.join('None' if kind is type(None) else f'a {kind.__name__}' for kind in kinds)}"
            hint = "give an object, or build the whole with ElevationMapConfig.from_dict"
            require(isinstance(value, annotation), f"cfg.{name}", rule, repr(value), hint, TypeError)
        if self.raycast is not None:
            self.raycast.require_grid(self.grid)
            fits = self.raycast.steps is None or self.fusion.averaging is not None
            rule, hint = "needs fusion.averaging, whose support it lowers", "give both, or neither"
            require(fits, "cfg.raycast.steps", rule, "fusion.averaging = None", hint)
        if isinstance(self.traversability, TraversabilityConfig):
            self.traversability.require_grid(self.grid)

    @property
    def has_levels(self) -> bool:
        """Whether cells hold other surfaces than the ground."""
        return self.levels is not None and self.levels.others > 0

    @property
    def drift_gate(self) -> float:
        """The least traversability of cells that measure the height drift: the setting, or the head's default.

        Without a head no cell is rated, and all known cells count.
        """
        if self.traversability is None:
            return 0.0
        if self.drift is not None and self.drift.min_traversability is not None:
            return self.drift.min_traversability
        return self.traversability.drift_gate

    def to_dict(self) -> dict[str, Any]:
        """Return the config as nested plain dicts, as YAML files and `state_dict` hold it."""
        values = dataclasses.asdict(dataclasses.replace(self, filters=()))
        channels = dict(values.pop("channels"))
        values |= {"channels": channels} if channels else {}
        if values["levels"] is None:  # files of maps without are read by versions that know none
            del values["levels"]
        return values | {"filters": [step.to_dict() for step in self.filters]}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> ElevationMapConfig:
        """Build a config from nested dicts.

        Args:
            values: settings by group and name; settings that are left out keep their defaults.

        Raises:
            ValueError: if there is no such setting, naming those that exist, or its value does not fit.
        """
        if isinstance(values, dict):
            values = without_header(values)
        if not isinstance(values, dict):
            return _build(cls, values, "config")
        others, completes = split_off_completion(values)
        values = values if completes else others  # a completion is refused as what is no setting
        stages = {name: value for name, value in values.items() if name not in ("filters", "channels")}
        own: dict[str, Any] = {"channels": values["channels"]} if values.get("channels") is not None else {}
        if "filters" in values:
            from torchelev.filters.chain import filters_from_list  # a map without filters needs none of them

            own["filters"] = filters_from_list(values["filters"])
        cfg = _build(cls, stages, "config")
        return dataclasses.replace(cfg, **own) if own else cfg

    @classmethod
    def like_em_cupy(cls, weights: str | Path | None = None, **parameters: float) -> ElevationMapConfig:
        """Return the config of a map that computes as elevation_mapping_cupy does where that differs from the paper.

        Points are gated by the variance and averaged, rays lower a cell's validity step by step, drift is corrected by
        a share. docs/howto/from_elevation_mapping.md has the equations and what differs still. Tensors update it.

        Args:
            weights: .npz of its traversability filter, see `PaperFilter.from_npz`. It also chooses the cells that
                measure the drift. None: the analytic head rates.
            parameters: of its core_param.yaml, by their names there, such as `resolution=0.04`; what is left out has
                the value of that file. `torchelev.io.em_cupy.load_config` reads whole files.

        Raises:
            ValueError: for a parameter that has no meaning here, or a value that is out of range.
        """
        return cls.from_dict(settings_like_em_cupy(parameters, weights))

    def save(self, path: str | Path) -> None:
        """Write all settings as JSON, by group and name, with a version.

        `load`, the command line's `--config` and the C library `libtorchelev` read it. Units are those of this class's
        fields: metres, seconds and radians.

        Raises:
            WriteError: the file cannot be written; an existing one is left as it was.
        """
        write_settings(path, self.to_dict())

    @classmethod
    def load(cls, path: str | Path) -> ElevationMapConfig:
        """Read a file of `save`, or one written by hand: JSON if its name ends in .json, else YAML.

        Raises:
            ValueError: the file cannot be read, is of another version, or holds a setting that does not exist or does
                not fit; settings that are left out keep their defaults.
        """
        values = read_settings(path)
        try:
            return cls.from_dict(values)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: {error}") from error


def _is_chain(filters: object) -> bool:
    """Return whether these are a tuple of filters' configs."""
    if isinstance(filters, tuple) and not filters:
        return True
    from torchelev.filters.chain import FilterConfig  # a map without filters needs none of them

    return isinstance(filters, tuple) and all(isinstance(step, FilterConfig) for step in filters)


@functools.cache
def setting_types(cls: type) -> dict[str, Any]:
    """Return the type of each of a config's settings, by name; that of filters, which are read apart, is not known."""
    hints = typing.get_type_hints(cls, localns={"FilterConfig": Any})
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def _build(cls: type, values: object, where: str) -> Any:
    """Return a config of this type from its plain dict; errors call it `where`."""
    require(isinstance(values, dict), where, "must be a mapping", type(values).__name__, "see ElevationMapConfig")
    assert isinstance(values, dict)
    hints = setting_types(cls)
    for name in values:
        require(name in hints, f"{where}.{name}", "is not a setting", repr(name), f"there are {', '.join(hints)}")
    return cls(**{name: _convert(hints[name], value, f"{where}.{name}") for name, value in values.items()})


def _share_of_settings(names: set[str], settings: set[str]) -> tuple[int, float]:
    """Return how many names are settings of a type, and their share of all names."""
    number = len(names & settings)
    return number, number / len(settings)


def _convert(hint: Any, value: object, where: str) -> Any:
    """Return a setting of this type from its plain value."""
    options = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    if value is None:
        require(type(None) in options, where, "cannot be switched off", "None", "leave it out to keep its default")
        return None
    kinds = [option for option in options if option is not type(None)]
    kind = kinds[0]
    if dataclasses.is_dataclass(kind):
        names = set(value) if isinstance(value, dict) else set()
        # Of several types, the one that has these settings, and few others: `robot` alone is the learned head's.
        kind = max(kinds, key=lambda k: _share_of_settings(names, set(setting_types(k))))
        return _build(typing.cast(type, kind), value, where)
    element = next(iter(typing.get_args(kind)), None)
    if dataclasses.is_dataclass(element):
        require(isinstance(value, list | tuple), where, "must be a list", type(value).__name__, "begin lines with -")
        items = enumerate(typing.cast(list, value))
        return tuple(_build(typing.cast(type, element), item, f"{where}[{k}]") for k, item in items)
    if isinstance(value, list):
        return tuple(value)
    if kind is float:
        value = from_json(value)
    number = isinstance(value, int | float) and not isinstance(value, bool)
    require(number or kind is not float, where, "must be a number", repr(value), "give a number without quotes")
    return float(value) if kind is float else value  # type: ignore[arg-type]


def differing_fields(a: dict[str, Any], b: dict[str, Any], where: str = "") -> list[str]:
    """Return the dotted names of the settings in which the dicts of two configs differ."""
    names = []
    for key in sorted(a.keys() | b.keys()):
        left, right = a.get(key), b.get(key)
        if isinstance(left, dict) and isinstance(right, dict):
            names += differing_fields(left, right, f"{where}{key}.")
        elif left != right:
            names.append(f"{where}{key}")
    return names
