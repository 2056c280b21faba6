"""What ground costs by its class: factors on the cost of a metre, and classes that are forbidden."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchelev.channels.config import ChannelConfig
from torchelev.channels.inputs import find_channel
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

Costs = Mapping[str, Mapping[str, float]]

_ARGUMENT = "cost.class_costs"
MIN_FACTOR = 1e-3  # of a cost: sums of float32 costs would lose smaller ones
_EXAMPLE = 'give {"terrain": {"mud": 3.0, "water": math.inf}}'


class ClassRating(NamedTuple):
    """What the classes of cells mean for their cost."""

    factor: Float[Tensor, "B H W"]  #: on the cost of a metre, positive and finite
    is_forbidden: Bool[Tensor, "B H W"]  #: the cell is too likely of a forbidden class


def parse_costs(costs: Any) -> dict[str, dict[str, float]]:
    """Return a copy of costs by channel and class.

    Raises:
        TypeError, ValueError: if they are no mapping of mappings, or a factor is out of range; inf is allowed.
    """
    _require_mapping(_ARGUMENT, costs)
    for channel, factors in costs.items():
        _require_mapping(f"{_ARGUMENT}[{channel!r}]", factors)
        for name, factor in factors.items():
            is_number = isinstance(factor, int | float) and not isinstance(factor, bool)
            is_factor = is_number and (MIN_FACTOR <= factor <= 1 / MIN_FACTOR or factor == math.inf)
            rule = f"must lie in [{MIN_FACTOR:g}, {1 / MIN_FACTOR:g}], or be inf"
            hint = "give 1 for plain ground, inf to forbid the class"
            require(is_factor, f"{_ARGUMENT}[{channel!r}][{name!r}]", rule, repr(factor), hint)
    return {channel: dict(factors) for channel, factors in costs.items()}


def _require_mapping(where: str, value: Any) -> None:
    require(isinstance(value, Mapping), where, "must be a dict", type(value).__name__, _EXAMPLE, TypeError)


def rate_classes(
    emap: ElevationMap, costs: Costs, max_forbidden: float, unknown_class_cost: float, state: MapState | None = None
) -> ClassRating:
    """Return the factor on the cost of each cell by the classes of its ground, and the cells that are forbidden.

    With the probabilities p_c of the classes c of a channel and their factors k_c, of which those of the set F are inf:

        factor:    sum p_c k_c / sum p_c over the classes that are not in F, unknown_class_cost where p is unknown
        forbidden: where sum p_c over F > max_forbidden

    The factors of several channels multiply. A class without a factor has k_c = 1.

    Args:
        emap: the maps.
        costs: factors by channel and class.
        max_forbidden: probability of all forbidden classes of a channel together that is still passable.
        unknown_class_cost: factor on cells whose class is unknown.
        state: the state to read; None: that of the maps.

    Raises:
        KeyError: the maps lack a channel, or it lacks a class.
        ValueError: a channel is not one of classes.
    """
    factors = {name: _all_factors(name, costs[name], emap.cfg.channels) for name in costs}  # before anything is read
    factor = torch.ones(emap.state.validity.shape, device=emap.device)
    is_forbidden = torch.zeros_like(emap.state.validity)
    for channel, of_classes in factors.items():
        probabilities, known = emap.read_channel(channel, state)
        rows = list(zip(of_classes, probabilities.unbind(-1), strict=True))
        nothing = torch.zeros_like(factor)
        weight = sum((p for k, p in rows if math.isfinite(k)), nothing)
        total = sum((k * p for k, p in rows if math.isfinite(k)), nothing)
        forbidden = sum((p for k, p in rows if math.isinf(k)), nothing)
        is_allowed = known & (weight > 0)
        mean = torch.where(is_allowed, total / torch.where(is_allowed, weight, 1.0), unknown_class_cost)
        factor = factor * mean
        is_forbidden = is_forbidden | (known & (forbidden > max_forbidden))
    return ClassRating(factor, is_forbidden)


def _all_factors(channel: str, given: Mapping[str, float], channels: Mapping[str, ChannelConfig]) -> list[float]:
    """Return the factors of all classes of a channel in their order."""
    cfg = find_channel(channel, channels, _ARGUMENT)
    rule, hint = "must name channels of classes", 'give the channel kind="class"'
    require(cfg.kind.startswith("class"), _ARGUMENT, rule, f"{channel!r} of kind {cfg.kind!r}", hint)
    names = [component.split(".")[1] for component in cfg.components(channel)]
    for name in given:
        hint = f"there are {', '.join(names)}"
        require(name in names, f"{_ARGUMENT}[{channel!r}]", "must name classes", repr(name), hint, KeyError)
    return [given.get(name, 1.0) for name in names]
