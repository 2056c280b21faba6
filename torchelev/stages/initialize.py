"""A first estimate of the ground: from the feet that stand on it, or from what was known of it before."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import torch
from torch import Tensor

from torchelev.grid import GridConfig, cell_centers, window_center
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

METHODS = ("linear", "nearest")


def initialize(
    state: MapState, feet: Float[Tensor, "B K 3"], method: str, grid: GridConfig, variance: float
) -> MapState:
    """Give unknown cells the height that `interpolate` finds for them, and that variance [m^2]."""
    dtype, center = state.elevation.dtype, window_center(state.corner, grid)[:, None]
    xy = (cell_centers(state.corner, grid).flatten(1, 2) - center).to(dtype)
    near = torch.cat([feet[..., :2].double() - center, feet[..., 2:].double()], -1).to(dtype)
    height, inside = interpolate(xy, near, method, grid.resolution)
    found = inside.view_as(state.validity) & ~state.validity
    return state._replace(
        elevation=torch.where(found, height.view_as(state.elevation), state.elevation),
        variance=torch.where(found, variance, state.variance),
        validity=state.validity | found,
        time=torch.where(found, 0.0, state.time),
        support=torch.where(found, 0.0, state.support),
        bounded=state.bounded & ~found,
    )


class Site(Protocol):
    """Where what was known before is kept; see `torchelev.site.SiteMap`."""

    def fill_state(self, emap: Any, T_map_base: Tensor | None, chosen: Tensor) -> MapState:
        """Return the map's state with what is known filled in, and remember that it comes from here."""


class Remembered(NamedTuple):
    """What was known of B windows before, NaN where nothing."""

    elevation: Float[Tensor, "B H W"]  #: [m]
    variance: Float[Tensor, "B H W"]  #: [m^2]
    time: Float[Tensor, "B H W"]  #: [s] since the last measurement
    upper_bound: Float[Tensor, "B H W"]  #: [m]


def recall(
    state: MapState, before: Remembered, chosen: Bool[Tensor, "B"], max_variance: float, support: float
) -> MapState:
    """Give the unknown cells of the chosen environments what was known of them before.

    The support [points] is how many measurements that disagree it takes to replace it.
    """
    is_open = chosen[:, None, None] & ~state.validity
    found = is_open & before.elevation.isfinite() & (before.variance < max_variance)
    bounded = is_open & ~found & ~state.bounded & before.upper_bound.isfinite()

    def fill(mask: Tensor, values: Tensor, others: Tensor) -> Tensor:
        return torch.where(mask, values.to(others.dtype), others)

    return state._replace(
        elevation=fill(found, before.elevation, state.elevation),
        variance=fill(found, before.variance, state.variance),
        validity=state.validity | found,
        time=fill(found, before.time, state.time),
        support=torch.where(found, support, state.support),
        challenger_support=torch.where(found, 0, state.challenger_support),
        upper_bound=fill(bounded, before.upper_bound, state.upper_bound),
        bounded=state.bounded & ~found | bounded,
    )


def interpolate(xy: Float[Tensor, "B C 2"], feet: Float[Tensor, "B K 3"], method: str, cell: float) -> tuple:
    """Return heights (B, C) [m] at `xy` from ground points, and where they hold.

    "nearest": the height of the nearest foot, everywhere. "linear": inside the feet's convex hull, widened by a cell of
    size `cell` [m]: the least-squares plane of the feet plus its errors weighted by inverse squared distance, so that
    feet on a plane give that plane and every foot its own height.
    """
    difference = xy[:, :, None] - feet[:, None, :, :2]
    distance = difference.square().sum(-1)
    if method == "nearest":
        height = feet[..., 2].gather(1, distance.argmin(-1))
        return height, torch.ones_like(height, dtype=torch.bool)
    plane, level = _plane(feet)
    mean = feet.mean(1, keepdim=True)
    at_feet = level + ((feet - mean)[..., :2] * plane[:, None]).sum(-1)
    weight = 1.0 / distance.clamp(min=1e-8)
    error = (weight * (feet[..., 2] - at_feet)[:, None]).sum(-1) / weight.sum(-1)
    height = level + ((xy - mean[..., :2]) * plane[:, None]).sum(-1) + error
    return height, _inside_hull(xy, feet[..., :2], cell)


def _plane(feet: Tensor) -> tuple[Tensor, Tensor]:
    """Return the gradient (B, 2) and mean height (B, 1); feet on one line give the gradient along it."""
    centered = feet - feet.mean(1, keepdim=True)
    gradient = torch.linalg.pinv(centered[..., :2], rtol=1e-4) @ centered[..., 2:]
    return gradient[..., 0], feet[..., 2].mean(1, keepdim=True)


def _inside_hull(xy: Tensor, corners: Tensor, margin: float, directions: int = 64) -> Bool[Tensor, "B C"]:
    """Return which points no direction separates from the corners' convex hull."""
    angle = torch.arange(directions, device=xy.device, dtype=xy.dtype) * (2 * math.pi / directions)
    direction = torch.stack([angle.cos(), angle.sin()])
    extent = (corners @ direction).amax(1)
    return (xy @ direction <= extent[:, None] + margin).all(-1)
