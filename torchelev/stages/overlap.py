"""Multi-floor buildings: near the robot only its own floor may stay in the map."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.grid import GridConfig
from torchelev.ops.masks import count
from torchelev.ops.storage import stored
from torchelev.stages.cells import center_offsets
from torchelev.state import LAYERS, MapState, Measurement, tally

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

STANCE = 0.5  # [m] half the size of the ground that a robot stands on


@dataclass(frozen=True, kw_only=True)
class OverlapConfig:
    """What is near, what is another floor, and how high robots are."""

    radius: float = 3.0  #: [m] horizontal distance from the base
    height: float = 1.5  #: [m] difference from the robot's height
    base_height: float = 0.6  #: [m] the robot's height is its base's, but no higher than this above its ground
    max_base_height: float = 2.5  #: [m] ground farther below the base is not what the robot stands on

    def __post_init__(self) -> None:
        require(self.radius > 0, "overlap.radius", "must be positive", self.radius, "give metres, or overlap=None")
        require(self.height > 0, "overlap.height", "must be positive", self.height, "give metres, or overlap=None")
        low, high = self.base_height, self.max_base_height
        require(low >= 0, "overlap.base_height", "must not be negative", low, "give metres; a legged robot's is 0.5")
        rule, hint = "must be at least overlap.base_height", "give the highest base of your robots [m]"
        require(high >= low, "overlap.max_base_height", rule, high, hint)


class Floor(NamedTuple):
    """The heights around the robot that belong to its own floor [m], from the base's height."""

    lower: Float[Tensor, "B 1 1"]  #: lowest height of the floor
    upper: Float[Tensor, "B 1 1"]  #: highest height of the floor


def clear_other_floors(state: MapState, m: Measurement, grid: GridConfig, cfg: OverlapConfig | None) -> MapState:
    """Clear cells near the robot whose height differs from the robot's by more than a threshold (paper, Sec. II-F).

    The robot's height is its base's, z_b, or that of a low base on the same ground: min(z_b, z_g + base_height), with
    z_g from `ground_below`. So a tall robot keeps its ground. Cells hit by this scan may differ by height * (1 + d /
    radius) at distance d: a slope is no other floor. What lies below the base is no upper floor. Skipped without a base
    pose or `cfg`. A cell's upper bound goes too when it belongs to another floor. The window is centred on the base.
    """
    if m.base is None or cfg is None:
        return state
    rows, columns = (middle(size, cfg.radius / grid.resolution) for size in (grid.height, grid.width))
    part = state._replace(**{name: getattr(state, name)[:, rows, columns] for name in LAYERS})
    x, y = center_offsets(state, m, grid)
    x, y = x[:, rows] - m.base[:, 0, None, None], y[:, :, columns] - m.base[:, 1, None, None]
    distance = (x.square() + y.square()).sqrt()
    near = distance <= cfg.radius
    base = m.base[:, 2, None, None]
    height, hit = (part.elevation - base).detach(), part.validity & (part.time == 0)
    floor = own_floor(ground_below(height, part.validity & near, hit & near, distance, cfg), cfg)
    slope = torch.where(hit, distance * (cfg.height / cfg.radius), 0.0)
    other = near & part.validity & is_outside(height, floor, slope)
    other_bound = near & part.bounded & is_outside((part.upper_bound - base).detach(), floor, 0.0)
    cleared = clear(part, other, other_bound)
    return tally(put_back(state, cleared, rows, columns), cleared_other_floors=count(other))


def middle(size: int, radius: float) -> slice:
    """Return which of so many cells along a side may lie within a radius [cells] of the window's centre."""
    half = math.ceil(min(radius, size)) + 1
    return slice(max(0, size // 2 - half), min(size, (size + 1) // 2 + half))


def put_back(state: MapState, part: MapState, rows: slice, columns: slice) -> MapState:
    """Return the state with what `clear` changes in some of its cells."""
    layers: dict[str, Any] = {}
    for name in ("validity", "bounded", "challenger_support"):
        layer, new = getattr(state, name), getattr(part, name)
        if new.shape != layer.shape:
            strip = layer[:, rows].slice_scatter(new, 2, columns.start, columns.stop)
            new = layer.slice_scatter(strip, 1, rows.start, rows.stop)
        layers[name] = new
    return state._replace(**layers)


@stored
def clear(state: MapState, cells: Bool[Tensor, "B H W"], bounds: Bool[Tensor, "B H W"]) -> MapState:
    """Forget the heights and bounds of some cells, and the bounds alone of others."""
    return state._replace(
        validity=state.validity & ~cells,
        bounded=state.bounded & ~(cells | bounds),
        challenger_support=torch.where(cells, 0, state.challenger_support),
    )


def ground_below(
    height: Tensor, known: Bool[Tensor, "B H W"], hit: Bool[Tensor, "B H W"], distance: Tensor, cfg: OverlapConfig
) -> Float[Tensor, "B 1 1"]:
    """Return the height of the ground on which the robot stands [m], from the base's; NaN-free, 0 where none is known.

    The mean, weighted by 1 / (d^2 + STANCE^2)^2, of the known cells within `max_base_height` below the base. Or of the
    cells that this scan hit at any depth below it: where the former are the smaller part of what is below, and thus
    furniture or a wall, and where the latter are higher by half of `height`, and thus a bridge over what was known.
    """
    below = known & (height <= 0)
    weight = torch.where(below, (distance.square() + STANCE**2).square().reciprocal(), 0.0)
    within, of_known = weighted_mean(height, torch.where(height >= -cfg.max_base_height, weight, 0.0))
    seen, of_hit = weighted_mean(height, torch.where(hit, weight, 0.0))
    stands = (within > 0.5 * weight.sum((1, 2), keepdim=True)) & ((seen == 0) | (of_hit <= of_known + 0.5 * cfg.height))
    return torch.where(stands, of_known, of_hit)  # 0 where nothing is hit


def weighted_mean(values: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return the sum of the weights, and the weighted mean, both (B, 1, 1)."""
    total = weight.sum((1, 2), keepdim=True)
    mean = torch.where(weight > 0, values * weight, 0.0).sum((1, 2), keepdim=True) / total.clamp(min=1e-12)
    return total, mean


def own_floor(ground: Float[Tensor, "B 1 1"], cfg: OverlapConfig) -> Floor:
    """Return what belongs to the floor of a robot above this ground; one that flies has none, and clears none below."""
    flies = ground < -cfg.max_base_height
    robot = torch.where(flies, 0.0, (ground + cfg.base_height).clamp(max=0))
    return Floor(torch.where(flies, -torch.inf, robot - cfg.height), (robot + cfg.height).clamp(min=0))


def is_outside(height: Tensor, floor: Floor, allowance: Tensor | float) -> Bool[Tensor, "B H W"]:
    """Tell which heights [m], from the base's, lie more than the allowance outside of the floor's."""
    return (height < floor.lower - allowance) | (height > floor.upper + allowance)
