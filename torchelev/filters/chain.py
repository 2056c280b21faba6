"""Filters in order: each makes a named layer from the map's layers and from those made before it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import nn

from torchelev.errors import require
from torchelev.filters.expressions.expression import Expression
from torchelev.filters.registry import KEYS, Filter
from torchelev.layers import LAYERS, Layer


@dataclass(frozen=True, kw_only=True)
class FilterConfig:
    """One filter of a chain: `FilterConfig(layer="smooth", filter="gaussian", settings={"sigma": 0.1})`.

    In YAML it is an entry of the list `filters`: `- {layer: smooth, filter: gaussian, inputs: elevation, sigma: 0.1}`.
    """

    layer: str  #: the name of what it makes
    filter: str  #: the name of the filter, see FILTERS
    inputs: tuple[str, ...] | str = ()  #: what it reads; left out: elevation, or what a formula names
    settings: Mapping[str, Any] | tuple[tuple[str, Any], ...] = ()  #: kept as pairs, as a config is hashed

    def __post_init__(self) -> None:
        settings = {name: _plain(value) for name, value in dict(self.settings).items()}
        for name in ("layer", "filter"):
            value = getattr(self, name)
            require(isinstance(value, str), f"filters.{name}", "must be a name", repr(value), "give text", TypeError)
        inputs = (self.inputs,) if isinstance(self.inputs, str) else tuple(self.inputs)
        if self.filter == "expression" and "formula" in settings:
            names = Expression(str(settings["formula"])).names
            hint = "leave inputs out: a formula names its own"
            require(inputs in ((), names), f"filters.{self.layer}", f"reads {', '.join(names)}", inputs, hint)
            inputs = names
        object.__setattr__(self, "inputs", inputs or ("elevation",))
        object.__setattr__(self, "settings", tuple(sorted(settings.items())))

    def to_dict(self) -> dict[str, Any]:
        """Return the entry that YAML has."""
        return {"layer": self.layer, "filter": self.filter, "inputs": list(self.inputs), **dict(self.settings)}


def _plain(value: Any) -> Any:
    """Return what can be hashed and written: tuples for lists, Python's numbers for NumPy's."""
    if isinstance(value, list):
        return tuple(value)
    return value.item() if isinstance(value, np.generic) else value


def filters_from_list(values: object) -> tuple[FilterConfig, ...]:
    """Read a list of entries. Raises ValueError for what is none, with its number."""
    hint = "write one as {layer: smooth, filter: gaussian, sigma: 0.1}"
    require(isinstance(values, list), "config.filters", "must be a list", type(values).__name__, hint)
    assert isinstance(values, list)
    for number, entry in enumerate(values):
        named = isinstance(entry, dict) and all(isinstance(entry.get(key), str) for key in ("layer", "filter"))
        require(named, f"config.filters[{number}]", "must name its layer and its filter", repr(entry), hint)
    return tuple(_from_dict(entry) for entry in values)


def _from_dict(entry: dict[str, Any]) -> FilterConfig:
    settings = {name: value for name, value in entry.items() if name not in KEYS}
    return FilterConfig(**{name: entry[name] for name in KEYS if name in entry}, settings=settings)


class FilterChain(nn.Module):
    """Filters in order.

    Each reads the map's layers and those that filters before it make. Raises ValueError when built for a filter,
    setting or layer that does not exist (a layer made later, or by itself, does not exist yet), naming what there is.

    ```python
    chain = FilterChain([FilterConfig(layer="smooth", filter="gaussian", settings={"sigma": 0.1})], resolution=0.04)
    values, known = chain({"elevation": (elevation, known)})["smooth"]
    ```
    """

    def __init__(
        self, filters: Sequence[FilterConfig], resolution: float, given: Sequence[str] = tuple(LAYERS)
    ) -> None:
        super().__init__()
        self.resolution = resolution
        self.inputs: dict[str, tuple[str, ...]] = {}
        self.steps = nn.ModuleList()
        for cfg in filters:
            self._append(cfg, [*given, *self.inputs])

    def _append(self, cfg: FilterConfig, there: list[str]) -> None:
        where = f"filters.{cfg.layer}"
        usable = cfg.layer.isidentifier() and cfg.layer not in there
        require(usable, where, "must be a name of its own, of letters and digits", repr(cfg.layer), "choose another")
        missing = [str(name) for name in cfg.inputs if name not in there]
        hint = f"there are {', '.join(there)}"
        require(not missing, where, "must read layers that are made before it", ", ".join(missing), hint)
        try:
            step = Filter(cfg.filter, **dict(cfg.settings))
            step.try_out(len(cfg.inputs), self.resolution)
        except (ValueError, TypeError) as error:
            raise type(error)(f"{where}: {error}") from error
        self.inputs[cfg.layer] = tuple(cfg.inputs)
        self.steps.append(step)

    def __contains__(self, name: object) -> bool:
        return name in self.inputs

    def read(self, name: str, given: Callable[[str], Layer], made: dict[str, Layer]) -> Layer:
        """Return a layer, running only what it needs; `made` holds what was made before, and gets what is made."""
        if name not in self.inputs:
            return given(name)
        if name not in made:
            layers = [self.read(source, given, made) for source in self.inputs[name]]
            step = self.steps[list(self.inputs).index(name)]
            made[name] = step(*layers, resolution=self.resolution)
        return made[name]

    def forward(self, layers: Mapping[str, Layer]) -> dict[str, Layer]:
        """Return all layers that the chain makes."""
        made: dict[str, Layer] = {}
        for name in self.inputs:
            self.read(name, layers.__getitem__, made)
        return made
