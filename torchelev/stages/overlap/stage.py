"""Multi-floor buildings: near the robot only its own floor may stay in the map."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.masks import count
from torchelev.stages.cells import center_offsets
from torchelev.stages.overlap.config import OverlapConfig
from torchelev.stages.overlap.square import clear_square
from torchelev.state import MapState, Measurement, tally

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, UInt8


STANCE = 0.5  # [m] half the size of the ground that a robot stands on
_LAYERS = ("elevation", "upper_bound", "time", "validity", "bounded", "challenger_support")


class Around(NamedTuple):
    """Where the cells lie, as seen from the robots' bases."""

    x: Float[Tensor, "B H 1"]  #: [m] from the base to the cells' centres
    y: Float[Tensor, "B 1 W"]  #: [m] from the base to the cells' centres
    base: Float[Tensor, "B 1 1"]  #: [m] height of the base
    part: tuple[int, int, int, int]  #: rows from, rows to, columns from, columns to that may be near; ends excluded


class Cleared(NamedTuple):
    """What is left of the cells."""

    validity: Bool[Tensor, "B H W"]  #: see `MapState`
    bounded: Bool[Tensor, "B H W"]  #: see `MapState`
    challenger_support: UInt8[Tensor, "B H W"]  #: see `MapState`
    number: Int[Tensor, "B"]  #: of cells whose heights were cleared


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
    if cfg is not None and cfg.square is not None:
        return clear_square(state, m, grid, cfg.square)
    if m.base is None or cfg is None:
        return state
    x, y = center_offsets(state, m, grid)
    base = m.base[..., None, None]
    around = Around(x - base[:, 0], y - base[:, 1], base[:, 2], near_part(grid, cfg))
    left = clear_near(state, around, cfg)
    support = left.challenger_support
    state = state._replace(validity=left.validity, bounded=left.bounded, challenger_support=support)
    return tally(state, cleared_other_floors=left.number)


def near_part(grid: GridConfig, cfg: OverlapConfig) -> tuple[int, int, int, int]:
    """Return which rows and columns may lie within the radius: from, to, from, to, the ends excluded."""
    rows, columns = (middle(size, cfg.radius / grid.resolution) for size in (grid.height, grid.width))
    return rows.start, rows.stop, columns.start, columns.stop


def clear_near(state: MapState, around: Around, cfg: OverlapConfig) -> Cleared:
    """Return what is left of the cells, and how many were cleared."""
    x, y, base, part = around
    rows, columns = slice(*part[:2]), slice(*part[2:])
    cells = state._replace(**{name: getattr(state, name)[:, rows, columns] for name in _LAYERS})
    square = x[:, rows].square() + y[:, :, columns].square()  # [m^2] of the distance
    near = square <= cfg.radius**2
    height, hit = (cells.elevation - base).detach(), cells.validity & (cells.time == 0)
    floor = own_floor(ground_below(height, cells.validity & near, hit & near, square, cfg), cfg)
    slope = torch.where(hit, square.sqrt() * (cfg.height / cfg.radius), 0.0)
    other = near & cells.validity & is_outside(height, floor, slope)
    other_bound = near & cells.bounded & is_outside((cells.upper_bound - base).detach(), floor, 0.0)
    left = clear(cells, other, other_bound)
    return Cleared(
        validity=put_back(state.validity, left.validity, rows, columns),
        bounded=put_back(state.bounded, left.bounded, rows, columns),
        challenger_support=put_back(state.challenger_support, left.challenger_support, rows, columns),
        number=count(other),
    )


def middle(size: int, radius: float) -> slice:
    """Return which of so many cells along a side may lie within a radius [cells] of the window's centre."""
    half = math.ceil(min(radius, size)) + 1
    return slice(max(0, size // 2 - half), min(size, (size + 1) // 2 + half))


def put_back(layer: Tensor, part: Tensor, rows: slice, columns: slice) -> Tensor:
    """Return a layer with some of its cells replaced."""
    if part.shape == layer.shape:
        return part
    strip = layer[:, rows].slice_scatter(part, 2, columns.start, columns.stop)
    return layer.slice_scatter(strip, 1, rows.start, rows.stop)


def clear(state: MapState, cells: Bool[Tensor, "B H W"], bounds: Bool[Tensor, "B H W"]) -> MapState:
    """Forget the heights and bounds of some cells, and the bounds alone of others."""
    return state._replace(
        validity=state.validity & ~cells,
        bounded=state.bounded & ~(cells | bounds),
        challenger_support=torch.where(cells, 0, state.challenger_support),
    )


def ground_below(
    height: Tensor, known: Bool[Tensor, "B H W"], hit: Bool[Tensor, "B H W"], square: Tensor, cfg: OverlapConfig
) -> Float[Tensor, "B 1 1"]:
    """Return the height of the ground on which the robot stands [m], from the base's; NaN-free, 0 where none is known.

    The mean, weighted by 1 / (d^2 + STANCE^2)^2, of the known cells within `max_base_height` below the base, with
    `square` = d^2 [m^2] and d the distance from the base. Or of the cells that this scan hit at any depth below it:
    where the former are the smaller part of what is below, and thus furniture or a wall, and where the latter are
    higher by half of `height`, and thus a bridge over what was known.
    """
    below = known & (height <= 0)
    weight = torch.where(below, (square + STANCE**2).square().reciprocal(), 0.0)
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
    """Return which heights [m], from the base's, lie more than the allowance outside of the floor's."""
    return (height < floor.lower - allowance) | (height > floor.upper + allowance)
