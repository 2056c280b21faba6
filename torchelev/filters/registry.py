"""Filters by name: functions from layers to a layer, and a module that holds one with its settings.

A filter is a function of one or more layers, each (values, known) of shape (B, H, W), and of keyword-only settings. It
returns a layer. `register` makes it known by its name, and keeps what is not known from every filter: values are 0
there, coming in and going out, so that no NaN of a user's reaches a sum or a gradient.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import torch
from torch import Tensor, nn

from torchelev.errors import message, require, require_positive
from torchelev.filters import opencv
from torchelev.layers import Layer
from torchelev.ops.storage import as_bytes, keep_freed_memory

if TYPE_CHECKING:
    from jaxtyping import Float

CPU_CELLS = 2**18  # filtered at a time on a CPU; measured: a third faster than all of 256 maps of 64 x 64 at once
KEYS = ("layer", "filter", "inputs")  # of a chain's entry, beside the filter's settings
FILTERS: dict[str, Callable[..., Layer]] = {}
F = TypeVar("F", bound=Callable[..., Layer])


def register(function: F) -> F:
    """Make a function a filter, known by its name.

    Its positional parameters are layers; its keyword-only ones are settings, of which `resolution` [m] is given by the
    map. It filters each map on its own: on a CPU it is given a few of many maps at a time, and float32 instead of half
    precision. What it returns that is not finite is unknown. Raises ValueError for a name that is taken, and for
    settings named as a chain's own keys.
    """
    name = function.__name__
    taken = FILTERS.get(name)
    ours = taken is None or (taken.__module__, taken.__qualname__) == (function.__module__, function.__qualname__)
    require(ours, "function", "must have a name of its own", repr(name), "choose another name")
    parameters = inspect.signature(function).parameters
    clash = [key for key in KEYS if key in parameters and parameters[key].kind is inspect.Parameter.KEYWORD_ONLY]
    require(not clash, name, f"must have no setting named {', '.join(KEYS)}", ", ".join(clash), "rename it")

    @functools.wraps(function)
    def checked(*layers: Layer, **settings: Any) -> Layer:
        check_layers(name, layers)
        given = layers[0][0]
        if given.is_cpu:
            keep_freed_memory()
        if given.shape[0] == 0:
            return layers[0]
        parts = [_filtered(name, function, part, settings) for part in _parts(layers)]
        values, known = parts[0]
        if len(parts) > 1:
            values, known = (torch.cat(pieces) for pieces in zip(*parts, strict=True))
        return values if values.dtype == given.dtype else values.to(given.dtype), known

    FILTERS[name] = checked
    return checked  # type: ignore[return-value]


def _filtered(name: str, function: Callable[..., Layer], layers: list[Layer], settings: dict[str, Any]) -> Layer:
    """Run a filter, and check what it returns: it may be a user's."""
    result = function(*map(masked, layers), **settings)
    check_layers(f"what filter {name} returns", (result,), layers[0][0].shape)
    return masked(result)


def check_layers(name: str, layers: tuple[Layer, ...], shape: tuple[int, ...] | None = None) -> None:
    """Raise ValueError unless layers are (B, H, W) with a mask each, all of one shape: of this one, if there is one."""
    # A refusal's text is composed only when it comes: that of a fitting layer took as long as all checks.
    for number, layer in enumerate(layers):
        pair = isinstance(layer, tuple) and len(layer) == 2 and all([isinstance(part, Tensor) for part in layer])
        if not pair or not _fits(*layer):
            _refuse(f"{name}, layer {number}", layer, pair)
    shapes = [values.shape for values, _ in layers] + ([] if shape is None else [shape])
    if len(set(shapes)) != 1:
        actual = [tuple(shape) for shape in shapes]
        raise ValueError(message(name, "expected one or more layers of one shape", actual, "read them from a map"))


def _fits(values: Tensor, known: Tensor) -> bool:
    shaped = values.ndim == 3 and values.shape == known.shape
    return shaped and values.is_floating_point() and known.dtype == torch.bool


def _refuse(argument: str, layer: Layer, pair: bool) -> NoReturn:
    hint = "make one of values with NaN by filters.as_layer"
    require(pair, argument, "must be a layer (values, known)", type(layer).__name__, hint, TypeError)
    values, known = layer
    actual = f"{tuple(values.shape)} {values.dtype} and {tuple(known.shape)} {known.dtype}"
    rule = "expected values (B, H, W) of floats and known (B, H, W)"
    require(known.dtype == torch.bool, argument, "known must be bool", known.dtype, "see as_layer")
    raise ValueError(message(argument, rule, actual, "see as_layer"))


def masked(layer: Layer) -> Layer:
    """Put 0 where nothing is known, and take what is not finite for unknown; at least float32.

    Not by `torch.where`, which takes five times as long on a CPU.
    """
    values, known = layer
    if opencv.serves(values):
        return opencv.masked(values, known)
    values = values.to(torch.promote_types(values.dtype, torch.float32))
    known = known & values.isfinite()
    return values.nan_to_num(0.0, 0.0, 0.0) * as_bytes(known).to(values.dtype), known


def _parts(layers: tuple[Layer, ...]) -> list[list[Layer]]:
    """Divide the maps into parts that fit into a CPU's caches."""
    maps, height, width = layers[0][0].shape
    some = max(1, CPU_CELLS // max(1, height * width)) if layers[0][0].is_cpu else max(1, maps)
    if maps <= some:
        return [list(layers)]
    pieces = [zip(values.split(some), known.split(some), strict=True) for values, known in layers]
    return [list(part) for part in zip(*pieces, strict=True)]


def settings_of(name: str) -> dict[str, inspect.Parameter]:
    """Return the settings that a filter takes, `resolution` left out."""
    parameters = inspect.signature(FILTERS[name]).parameters
    return {n: p for n, p in parameters.items() if p.kind is p.KEYWORD_ONLY and n != "resolution"}


def listing() -> str:
    """Describe all filters, a paragraph each: inputs, settings with their defaults, and what it returns."""
    lines = []
    for name, function in sorted(FILTERS.items()):
        inputs = [str(p) for p in inspect.signature(function).parameters.values() if p.kind is not p.KEYWORD_ONLY]
        settings = [n if p.default is p.empty else f"{n}={p.default!r}" for n, p in settings_of(name).items()]
        names = ", ".join(text.split(":")[0] for text in inputs)
        lines.append(f"{name}({names})" + (f"  {', '.join(settings)}" if settings else ""))
        lines.append(f"    {(inspect.getdoc(function) or '').partition(chr(10))[0]}")
    return "\n".join(lines)


def as_layer(values: Float[Tensor, "B H W"]) -> Layer:
    """Turn values, NaN or inf where unknown, into a layer."""
    known = torch.isfinite(values)
    return torch.where(known, values, 0.0), known


def as_nan(layer: Layer) -> Float[Tensor, "B H W"]:
    """Return the values of a layer, NaN where unknown."""
    values, known = layer
    return torch.where(known, values, torch.nan)


def radius_cells(radius: float, resolution: float) -> int:
    """Return how many cells a window reaches from its middle: the nearest whole number, at least 1."""
    require_positive(radius=radius, resolution=resolution)
    return max(1, round(radius / resolution))


class Filter(nn.Module):
    """A filter and its settings: `Filter("gaussian", sigma=0.1)(layer, resolution=0.04)`.

    A filter or a setting that does not exist is refused when it is built, with what there is; a setting out of range
    when it runs, or by `try_out`. Raises ValueError.
    """

    def __init__(self, name: str, **settings: Any) -> None:
        super().__init__()
        known = ", ".join(sorted(FILTERS))
        require(name in FILTERS, "filter", "must be a filter's name", repr(name), f"there are {known}")
        there = settings_of(name)
        others = sorted(set(settings) - set(there))
        hint = f"it takes {', '.join(there) or 'none'}"
        require(not others, f"filter {name}", "must be given settings that it has", ", ".join(others), hint)
        missing = [n for n, p in there.items() if p.default is p.empty and n not in settings]
        require(not missing, f"filter {name}", f"needs {', '.join(missing)}", "none", "give a number for each")
        self.name, self.settings = name, settings
        self.takes_resolution = "resolution" in inspect.signature(FILTERS[name]).parameters

    def forward(self, *layers: Layer, resolution: float) -> Layer:
        """Filter layers of cells of `resolution` [m]."""
        given = {"resolution": resolution} if self.takes_resolution else {}
        return FILTERS[self.name](*layers, **given, **self.settings)

    def try_out(self, inputs: int, resolution: float) -> None:
        """Run on a small map, to refuse settings out of range and a wrong number of layers."""
        parameters = inspect.signature(FILTERS[self.name]).parameters.values()
        wanted = sum(p.kind is p.POSITIONAL_OR_KEYWORD for p in parameters)
        any_number = any(p.kind is p.VAR_POSITIONAL for p in parameters)
        fits = inputs >= max(1, wanted) if any_number else inputs == wanted
        actual = f"{inputs} inputs"
        require(fits, f"filter {self.name}", f"takes {wanted} layers", actual, "name as many inputs")
        layer = torch.zeros(1, 4, 4), torch.eye(4, dtype=torch.bool)[None]
        self(*[layer] * inputs, resolution=resolution)

    def extra_repr(self) -> str:
        """Say which filter it is, and its settings."""
        return ", ".join([self.name, *(f"{name}={value!r}" for name, value in self.settings.items())])
