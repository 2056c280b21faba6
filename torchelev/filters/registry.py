"""Filters by name: `register` makes a function a filter, `Filter` is the module of one with its settings.

A filter is a function of one or more layers, each (values, known) of shape (B, H, W), with keyword-only settings. It
returns a layer. Around every filter, values are 0 where unknown, on input and on output, so that a NaN never reaches a
sum or a gradient.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import nn

from torchelev.errors import require
from torchelev.filters.layer_tools import check_layers, zero_unknown
from torchelev.layers import Layer
from torchelev.ops.storage import keep_freed_memory

ENTRY_KEYS = ("layer", "filter", "inputs")  # of a filter's entry in a chain; all other keys are settings
FILTERS: dict[str, Callable[..., Layer]] = {}
MAX_CPU_CELLS = 2**18  # per call on a CPU; measured: a third faster than 256 maps of 64 x 64 at once
F = TypeVar("F", bound=Callable[..., Layer])


def register(function: F) -> F:
    """Register a function as a filter under its name.

    Its positional parameters are layers, its keyword-only ones settings. A setting named `resolution` [m] is filled in
    from the map. The function must treat each map on its own: on a CPU it receives a few maps of a large batch at a
    time, and half precision as float32. Results that are not finite become unknown.

    Args:
        function: takes layers (values, known), values 0 where unknown, and returns a layer of the same shape.

    Returns:
        The filter. It also checks its layers.

    Raises:
        ValueError: if the name is taken, or a setting is named `layer`, `filter` or `inputs`.
    """
    name = function.__name__
    existing = FILTERS.get(name)
    is_same = existing and (existing.__module__, existing.__qualname__) == (function.__module__, function.__qualname__)
    require(not existing or bool(is_same), "function", "must have a name of its own", repr(name), "rename it")
    parameters = inspect.signature(function).parameters
    clash = [key for key in ENTRY_KEYS if key in parameters and _is_keyword_only(parameters[key])]
    require(not clash, name, f"must have no setting named {', '.join(ENTRY_KEYS)}", ", ".join(clash), "rename it")

    @functools.wraps(function)
    def checked(*layers: Layer, **settings: Any) -> Layer:
        check_layers(name, layers)
        original = layers[0][0]
        if original.is_cpu:
            keep_freed_memory()
        if original.shape[0] == 0:
            return layers[0]
        parts = [_run(name, function, part, settings) for part in _split_batch(layers)]
        values, known = parts[0]
        if len(parts) > 1:
            values, known = (torch.cat(pieces) for pieces in zip(*parts, strict=True))
        return values if values.dtype == original.dtype else values.to(original.dtype), known

    FILTERS[name] = checked
    return checked  # type: ignore[return-value]


def _is_keyword_only(parameter: inspect.Parameter) -> bool:
    return parameter.kind is inspect.Parameter.KEYWORD_ONLY


def _run(name: str, function: Callable[..., Layer], layers: list[Layer], settings: dict[str, Any]) -> Layer:
    """Run a filter and check what it returns: it may be a user's."""
    result = function(*map(zero_unknown, layers), **settings)
    check_layers(f"what filter {name} returns", (result,), layers[0][0].shape)
    return zero_unknown(result)


def _split_batch(layers: tuple[Layer, ...]) -> list[list[Layer]]:
    """Split a batch into parts that fit into a CPU's caches; other devices take it whole."""
    maps, H, W = layers[0][0].shape
    size = max(1, MAX_CPU_CELLS // max(1, H * W)) if layers[0][0].is_cpu else max(1, maps)
    if maps <= size:
        return [list(layers)]
    pieces = [zip(values.split(size), known.split(size), strict=True) for values, known in layers]
    return [list(part) for part in zip(*pieces, strict=True)]


def settings_of(name: str) -> dict[str, inspect.Parameter]:
    """Return the settings of a filter, without `resolution`."""
    parameters = inspect.signature(FILTERS[name]).parameters
    return {n: p for n, p in parameters.items() if _is_keyword_only(p) and n != "resolution"}


def listing() -> str:
    """Describe all filters, a paragraph each: inputs, settings with their defaults, and the result."""
    lines = []
    for name, function in sorted(FILTERS.items()):
        inputs = [str(p) for p in inspect.signature(function).parameters.values() if not _is_keyword_only(p)]
        settings = [n if p.default is p.empty else f"{n}={p.default!r}" for n, p in settings_of(name).items()]
        names = ", ".join(text.split(":")[0] for text in inputs)
        lines.append(f"{name}({names})" + (f"  {', '.join(settings)}" if settings else ""))
        lines.append(f"    {(inspect.getdoc(function) or '').partition(chr(10))[0]}")
    return "\n".join(lines)


class Filter(nn.Module):
    """A filter with its settings, as a module: `Filter("gaussian", sigma=0.1)(layer, resolution=0.04)`.

    Args:
        name: of a registered filter, see `FILTERS`.
        **settings: the filter's keyword-only arguments, without `resolution`.

    Raises:
        ValueError: if there is no such filter or setting, naming those that exist. Values out of range raise when the
            filter runs, or in `try_out`.
    """

    def __init__(self, name: str, **settings: Any) -> None:
        super().__init__()
        names = ", ".join(sorted(FILTERS))
        require(name in FILTERS, "filter", "must be a filter's name", repr(name), f"there are {names}")
        available = settings_of(name)
        unknown = sorted(set(settings) - set(available))
        hint = f"it takes {', '.join(available) or 'none'}"
        require(not unknown, f"filter {name}", "must be given settings that it has", ", ".join(unknown), hint)
        missing = [n for n, p in available.items() if p.default is p.empty and n not in settings]
        require(not missing, f"filter {name}", f"needs {', '.join(missing)}", "none", "give a value for each")
        self.name, self.settings = name, settings
        self.takes_resolution = "resolution" in inspect.signature(FILTERS[name]).parameters

    def forward(self, *layers: Layer, resolution: float) -> Layer:
        """Filter layers whose cells are `resolution` [m] wide."""
        given = {"resolution": resolution} if self.takes_resolution else {}
        return FILTERS[self.name](*layers, **given, **self.settings)

    def try_out(self, num_inputs: int, resolution: float) -> None:
        """Run on a small map, so that a wrong number of layers and settings out of range raise now."""
        parameters = inspect.signature(FILTERS[self.name]).parameters.values()
        expected = sum(p.kind is p.POSITIONAL_OR_KEYWORD for p in parameters)
        is_variadic = any(p.kind is p.VAR_POSITIONAL for p in parameters)
        fits = num_inputs >= max(1, expected) if is_variadic else num_inputs == expected
        rule, actual = f"takes {expected} layers", f"{num_inputs} inputs"
        require(fits, f"filter {self.name}", rule, actual, "name as many inputs")
        layer = torch.zeros(1, 4, 4), torch.eye(4, dtype=torch.bool)[None]
        self(*[layer] * num_inputs, resolution=resolution)

    def extra_repr(self) -> str:
        """Return the filter's name and settings, for `repr`."""
        return ", ".join([self.name, *(f"{name}={value!r}" for name, value in self.settings.items())])
