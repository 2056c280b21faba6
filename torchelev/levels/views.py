"""What is over and under what: ceilings, clearance, and surfaces from below."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.layers import Layer, absolute_variance
from torchelev.levels.state import Levels
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from torchelev.config import ElevationMapConfig

BY_LEVEL = ("elevation", "underside", "variance", "time", "validity")  # layers of each surface


class View(NamedTuple):
    """All surfaces of the cells: first the ground, then the others in no order."""

    lower: Float[Tensor, "B K H W"]  #: [m]; of the ground its elevation, as nobody sees its underside
    upper: Float[Tensor, "B K H W"]  #: [m]
    variance: Float[Tensor, "B K H W"]  #: [m^2]
    time: Float[Tensor, "B K H W"]  #: [s]
    known: Bool[Tensor, "B K H W"]  #: the surface is there, and has enough points
    floor: Float[Tensor, "B H W"]  #: [m] the elevation, or the upper bound where that is not known
    has_floor: Bool[Tensor, "B H W"]  #: one of them is known
    free_top: Float[Tensor, "B H W"]  #: [m] see `Levels`


def view(levels: Levels, state: MapState, cfg: ElevationMapConfig) -> View:
    """Return all surfaces of the cells of a map."""
    assert cfg.levels is not None

    def stack(ground: Tensor, others: Tensor) -> Tensor:
        return torch.cat([ground[:, None], others.to(ground.dtype)], 1)

    return View(
        lower=stack(state.elevation, levels.lower),
        upper=stack(state.elevation, levels.upper),
        variance=stack(absolute_variance(state), levels.variance),
        time=stack(state.time, levels.time),
        known=stack(state.validity, levels.support >= cfg.levels.least_support),
        floor=torch.where(state.validity, state.elevation, state.upper_bound),
        has_floor=state.validity | state.bounded,
        free_top=levels.free_top,
    )


def ceiling(surfaces: View, min_gap: float) -> Layer:
    """Return the underside of the lowest surface above the ground [m], and where it is known.

    It is infinite where rays passed at least `min_gap` above the ground and met nothing. Where the ground is not known,
    its upper bound stands for it.
    """
    floor = surfaces.floor[:, None]
    is_above = surfaces.known[:, 1:] & (surfaces.lower[:, 1:] > floor)
    lowest = torch.where(is_above, surfaces.lower[:, 1:], torch.inf).amin(1)
    is_open = surfaces.free_top >= surfaces.floor + min_gap
    return lowest, surfaces.has_floor & ((lowest < torch.inf) | is_open)


def clearance(surfaces: View, min_gap: float) -> Layer:
    """Return the height of the ceiling above the ground [m], and where both are known."""
    height, known = ceiling(surfaces, min_gap)
    return height - surfaces.floor, known & surfaces.known[:, 0]


def by_level(name: str, level: int, surfaces: View) -> Layer:
    """Return a layer of the surface with so many surfaces below it, and where there is one.

    Raises:
        KeyError: if the layer is none of a surface.
        ValueError: if no cell has so many surfaces.
    """
    K = surfaces.lower.shape[1]
    require(
        name in BY_LEVEL, "layer", "must be one of a level", repr(name), f"there are {', '.join(BY_LEVEL)}", KeyError
    )
    is_level = isinstance(level, int) and not isinstance(level, bool) and 0 <= level < K
    require(
        is_level, "level", f"must be a whole number from 0, the lowest, to {K - 1}", repr(level), "count from below"
    )
    order = torch.where(surfaces.known, surfaces.upper, torch.inf).argsort(stable=True, dim=1)[:, level, None]
    known = surfaces.known.gather(1, order)[:, 0]
    if name == "validity":
        return known.to(surfaces.upper.dtype), torch.ones_like(known)
    if name == "underside":
        is_ground = order[:, 0] == 0
        return surfaces.lower.gather(1, order)[:, 0], known & ~is_ground
    source = {"elevation": surfaces.upper, "variance": surfaces.variance, "time": surfaces.time}[name]
    return source.gather(1, order)[:, 0], known
