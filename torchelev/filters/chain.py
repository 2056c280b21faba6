"""Filter chains: each filter makes a named layer from the map's layers and from layers made before it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import nn

from torchelev.errors import require
from torchelev.filters.expressions.expression import Expression
from torchelev.filters.registry import ENTRY_KEYS, Filter
from torchelev.layers import LAYERS, Layer


@dataclass(frozen=True, kw_only=True)
class FilterConfig:
    """One filter of a chain: `FilterConfig(layer="smooth", filter="gaussian", settings={"sigma": 0.1})`.

    In YAML it is an entry of the list `filters`: `- {layer: smooth, filter: gaussian, inputs: elevation, sigma: 0.1}`.
    """

    layer: str  #: name of the layer that the filter makes
    filter: str  #: name of the filter, see `FILTERS`
    #: names of the layers that the filter reads; by default elevation, or the layers in the formula of an expression
    inputs: tuple[str, ...] | str = ()
    settings: Mapping[str, Any] | tuple[tuple[str, Any], ...] = ()  #: settings of the filter, by name

    def __post_init__(self) -> None:
        settings = {name: _hashable(value) for name, value in dict(self.settings).items()}
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
        """Return the YAML entry as a dict."""
        return {"layer": self.layer, "filter": self.filter, "inputs": list(self.inputs), **dict(self.settings)}


def _hashable(value: Any) -> Any:
    """Return a setting as a tuple if it is a list, and as a Python number if it is a NumPy one."""
    if isinstance(value, list):
        return tuple(value)
    return value.item() if isinstance(value, np.generic) else value


def filters_from_list(values: object) -> tuple[FilterConfig, ...]:
    """Read the list `filters` of a config file.

    Raises:
        ValueError: if an entry does not name its layer and filter; the text says which entry.
    """
    hint = "write one as {layer: smooth, filter: gaussian, sigma: 0.1}"
    require(isinstance(values, list), "config.filters", "must be a list", type(values).__name__, hint)
    assert isinstance(values, list)
    for number, entry in enumerate(values):
        is_named = isinstance(entry, dict) and all(isinstance(entry.get(key), str) for key in ("layer", "filter"))
        require(is_named, f"config.filters[{number}]", "must name its layer and its filter", repr(entry), hint)
    return tuple(_from_dict(entry) for entry in values)


def _from_dict(entry: dict[str, Any]) -> FilterConfig:
    settings = {name: value for name, value in entry.items() if name not in ENTRY_KEYS}
    return FilterConfig(**{key: entry[key] for key in ENTRY_KEYS if key in entry}, settings=settings)


class FilterChain(nn.Module):
    """Filters in order, each reading the map's layers and the layers made before it.

    ```python
    chain = FilterChain([FilterConfig(layer="smooth", filter="gaussian", settings={"sigma": 0.1})], resolution=0.04)
    values, known = chain({"elevation": (elevation, known)})["smooth"]
    ```

    Args:
        filters: in the order in which they run.
        resolution: [m] of a cell.
        given: names of the layers that exist before the chain.

    Raises:
        ValueError: if a filter, a setting or an input layer does not exist, naming those that do; if a new layer's
            name is taken or no identifier.
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

    def _append(self, cfg: FilterConfig, available: list[str]) -> None:
        where = f"filters.{cfg.layer}"
        is_valid = cfg.layer.isidentifier() and cfg.layer not in available
        require(is_valid, where, "must be a name of its own, of letters and digits", repr(cfg.layer), "rename it")
        missing = [str(name) for name in cfg.inputs if name not in available]
        hint = f"there are {', '.join(available)}"
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
        """Return a layer by name, running only the filters that it depends on.

        Args:
            name: of a layer of the chain or of the map.
            given: returns a layer of the map by name.
            made: layers of the chain that exist already; new ones are added.
        """
        if name not in self.inputs:
            return given(name)
        if name not in made:
            layers = [self.read(source, given, made) for source in self.inputs[name]]
            step = self.steps[list(self.inputs).index(name)]
            made[name] = step(*layers, resolution=self.resolution)
        return made[name]

    def forward(self, layers: Mapping[str, Layer]) -> dict[str, Layer]:
        """Return all layers of the chain, from the map's layers by name."""
        made: dict[str, Layer] = {}
        for name in self.inputs:
            self.read(name, layers.__getitem__, made)
        return made
