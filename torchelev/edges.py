"""Walls and steps within a cell: is the cell's height that of the top or of the ground before it?"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.disputed import step_heights
from torchelev.grid import GridConfig
from torchelev.storage import as_bytes, realize
from torchelev.windows import AROUND, neighbours

if TYPE_CHECKING:
    from jaxtyping import Float

    from torchelev.fusion import FusionConfig, Prior, Scan


@dataclass(frozen=True, kw_only=True)
class EdgeConfig:
    """When a cell counts as a step: many points, and many of them far from the cell's estimate."""

    min_points: int = 6
    min_share: float = 0.25  # of the cell's points outside the gate around its estimate
    min_passed: float = 0.1  # of its low points, how many passed the centre for the ground to win over the top
    min_extreme: int = 2  # points within a standard deviation of the top or bottom, or beyond; fewer are outliers
    refinements: int = 7  # each halves the distance to the top of a wall's face
    margin: float = 0.25  # standard deviations below the top that still belong to it
    min_settled: float = 6.0  # points; support from which a wall's top stands although a scan sees less of its face


def side_of_step(
    scan: Scan, prior: Prior, step: Tensor, mean: Tensor, number: Tensor, grid: GridConfig, cfg: FusionConfig
) -> tuple[Tensor, Tensor]:
    """Keep walls and steps sharp (paper, Sec. II-C): in a cell that holds a step, ignore the points of the wrong side.

    The paper ignores the points below the estimate, so that the top of a wall wins over its face. The top is wrong
    where the wall starts beyond the cell's centre: there, rays passed over the centre and hit low, so the ground is
    what lies at the centre, and points above are ignored. Returns the side (B, C), +1 top, -1 ground and 0 no step,
    and that side's height [m]. `mean` [m] and `number` (B, C) are those of the cell's points.
    """
    edges = cfg.edges
    assert edges is not None
    columns = (*scan.columns(), [part.detach() for part in scan.ray], as_bytes(scan.passed))
    found = step_heights(as_bytes(step), *columns, mean, edges.refinements, edges.margin, edges.min_extreme)
    top, bottom, passed_low, *ray = found.unbind(0)
    # A wall that shows in no other cell must not vanish: then the top wins even where rays passed the centre.
    scanned = neighbour_maximum(torch.where(number > 0, mean, -1e6), None, grid)
    mapped = neighbour_maximum(torch.where(prior.known, prior.elevation, -1e6), ray, grid)
    elsewhere = (scanned >= 0.5 * (mean + top)) | (mapped >= top - cfg.relief * grid.resolution)
    ground = step & elsewhere & (passed_low > edges.min_passed)
    return torch.where(step, torch.where(ground, -1.0, 1.0), 0.0), torch.where(ground, bottom, top)


def neighbour_maximum(
    cells: Float[Tensor, "B C"], ray: list[Float[Tensor, "B C"]] | None, grid: GridConfig
) -> Float[Tensor, "B C"]:
    """Return the highest value of the neighbours of each cell; given rays, of those within 50 degrees behind it.

    Beside it along a wall lie cells that show the wall's face too, and the wall would end as every other cell's.
    """
    shape = (grid.height, grid.width)
    heights = neighbours(cells.detach().unflatten(1, shape), -1e6)
    if ray is not None:
        x, y = (part.unflatten(1, shape) for part in ray)
        limit = math.cos(math.radians(50)) * (x.square() + y.square()).sqrt()
        behind = [i * x + j * y > math.hypot(i, j) * limit for i, j in AROUND]
        heights = [torch.where(mask, height, -1e6) for mask, height in zip(behind, heights, strict=True)]
    return realize(functools.reduce(torch.maximum, heights)).flatten(1)
