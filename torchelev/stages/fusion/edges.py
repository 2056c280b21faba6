"""Walls and steps within a cell: is the cell's height that of the top or of the ground before it?"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.ops.windows import around
from torchelev.stages.fusion.config import EdgeConfig

if TYPE_CHECKING:
    from torchelev.stages.fusion.contested import CellHeights, ContestedCells


def side_of_step(
    points: ContestedCells, shown: CellHeights, width: int, relief: float, cfg: EdgeConfig
) -> tuple[Tensor, Tensor]:
    """Keep walls and steps sharp (paper, Sec. II-C): choose the cell's side of a step; `fusion` drops the other.

    The paper ignores the points below the estimate, so that the top of a wall wins over its face. The top is wrong
    where the wall starts beyond the cell's centre: there, rays passed over the centre and hit low, so the ground is
    what lies at the centre. Returns the side (K,), +1 top and -1 ground, and its height (K,) [m] above the mean.
    """
    top, bottom = ends_of_step(points, cfg)
    low = points.used * (points.z < 0)
    columns = [low, low * points.passed, *(points.used * part for part in points.ray)]
    number_low, number_passed, x, y = points.sum(torch.stack(columns)).unbind(0)
    # A wall that shows in no other cell must not vanish: then the top wins even where rays passed the centre.
    di, dj = around(x.device)
    exists, (in_scan, in_map) = values_around(list(shown), points.cells, di, dj, width)
    middle, top_height = points.mean + 0.5 * top, points.mean + top - relief
    behind = (in_map >= top_height[:, None]) & lie_behind(x, y, di, dj)
    has_top_beside = (exists & ((in_scan >= middle[:, None]) | behind)).any(1)
    ground = (number_passed > cfg.min_passed * number_low) & has_top_beside
    return torch.where(ground, -1.0, 1.0).to(x.dtype), torch.where(ground, bottom, top)


def ends_of_step(points: ContestedCells, cfg: EdgeConfig) -> tuple[Tensor, Tensor]:
    """Return the heights (K,) of the step's top and bottom [m] above the mean.

    The top is the mean of the points above the mean, repeated: each of the `refinements` halves the distance to the
    top of a wall's face. The bottom is the top of the step upside down, and takes two.
    """
    return top_of_step(points, points.z, cfg, cfg.refinements), -top_of_step(points, -points.z, cfg, 2)


def top_of_step(points: ContestedCells, z: Tensor, cfg: EdgeConfig, rounds: int) -> Tensor:
    """Move heights (K,) from 0 to the mean of the points at or past them, so many times; `z` (P,) are the points'.

    Up to `margin` standard deviations short of a height lies past it. A level that fewer than `min_extreme` points
    reach, give or take a standard deviation, is an outlier's, and no height lies above it.
    """
    noise = points.spread.sqrt()
    z, past = levels(z, cfg.margin * noise)
    highest = level_reached(points, torch.where(points.used > 0, z + noise, -torch.inf), cfg.min_extreme)
    columns = torch.stack([points.weight * z, points.weight])
    height = torch.zeros_like(highest)
    for _ in range(rounds):
        height = climb(points, columns, past, highest, height)
    return height


def levels(z: Tensor, margin: Tensor) -> tuple[Tensor, Tensor]:
    """Return the points' heights (P,) [m], and up to which heights each counts as past them."""
    return z, z + margin


def climb(points: ContestedCells, columns: Tensor, past: Tensor, highest: Tensor, height: Tensor) -> Tensor:
    """Move heights (K,) to the mean of the points past them, but no higher than `highest`."""
    moment, total = points.sum(columns * (past >= points.at_points(height))).unbind(0)
    mean = moment / total  # NaN where no point lies past the height, which compares as false
    return torch.where(highest >= mean, mean, height)


def level_reached(points: ContestedCells, reached: Tensor, number: int) -> Tensor:
    """Return the highest level (K,) that so many of a cell's points reach; `reached` (P,) is each point's level."""
    level = points.highest(reached)
    for _ in range(number - 1):
        at = points.at_points(level)
        next_level = points.highest(torch.where(reached < at, reached, -torch.inf))
        enough = points.sum(points.used * (reached >= at)) >= number
        level = torch.where(enough, level, next_level)
    return level


def values_around(
    layers: list[Tensor], cells: Tensor, di: Tensor, dj: Tensor, width: int
) -> tuple[Tensor, list[Tensor]]:
    """Read layers (B, C) at the eight neighbours (di, dj) of cells (K,) numbered across environments.

    Returns which neighbours lie on the map, (K, 8), and each layer's values there, (K, 8).
    """
    num_cells = layers[0].shape[1]
    i, j = cells % num_cells // width, cells % width
    i, j = i[:, None] + di, j[:, None] + dj
    exists = (i >= 0) & (i < num_cells // width) & (j >= 0) & (j < width)
    place = torch.where(exists, cells[:, None] + di * width + dj, 0)
    return exists, [layer.take(place) for layer in layers]


def lie_behind(x: Tensor, y: Tensor, di: Tensor, dj: Tensor) -> Tensor:
    """Return which neighbours (di, dj) of a cell lie behind it, (K, 8), within 50 degrees of where its rays (K,) go.

    Beside it along a wall lie cells that show the wall's face too, and the wall would end as every other cell's.
    """
    di, dj = di.to(x.dtype), dj.to(x.dtype)
    limit = math.cos(math.radians(50)) * (di.square() + dj.square()).sqrt()
    along = x[:, None] * di + y[:, None] * dj
    return along > limit * (x.square() + y.square()).sqrt()[:, None]
