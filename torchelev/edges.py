"""Walls and steps within a cell: is the cell's height that of the top or of the ground before it?"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.disputed import Disputed, moved_by
from torchelev.grid import GridConfig
from torchelev.storage import as_bytes
from torchelev.windows import around

if TYPE_CHECKING:
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
    points = (*scan.columns(), [part.detach() for part in scan.ray], as_bytes(scan.passed))
    shown = [torch.where(number > 0, mean, UNSEEN), torch.where(prior.known, prior.elevation, UNSEEN).detach()]
    limits = (edges.refinements, edges.margin, edges.min_extreme, edges.min_passed, cfg.relief * grid.resolution)
    side, height = step_side(as_bytes(step), *points, mean, shown, grid.width, *limits).unbind(0)
    return side, height


UNSEEN = -1e6  # [m] below every height


@torch.library.custom_op(
    "torchelev::step_side",
    mutates_args=(),
    schema="(Tensor cells, Tensor slot, Tensor z, Tensor spread, Tensor weight, Tensor[] ray, Tensor passed, "
    "Tensor mean, Tensor[] shown, SymInt width, SymInt refinements, float margin, SymInt min_extreme, "
    "float min_passed, float relief) -> Tensor",
)
def step_side(
    cells: Tensor,
    slot: Tensor,
    z: Tensor,
    spread: Tensor,
    weight: Tensor,
    ray: list[Tensor],
    passed: Tensor,
    mean: Tensor,
    shown: list[Tensor],
    width: int,
    refinements: int,
    margin: float,
    min_extreme: int,
    min_passed: float,
    relief: float,
) -> Tensor:
    """Return the side and its height of each cell marked as a step, (2, B, C); zero elsewhere.

    `shown` holds the heights (B, C) that the scan and the map show, `width` counts cells along y, `relief` is in [m].
    """
    points = Disputed(cells, slot, z, spread, weight, passed, *ray)
    passed, *ray = points.others
    middle = points.of(mean)
    top, bottom = ends_of_step(points, middle, refinements, margin, min_extreme)
    used = (points.weight > 0).to(mean.dtype)
    low = used * (points.z < points.at_points(middle))
    ground = points.sum(low * passed) > min_passed * points.sum(low)
    # A wall that shows in no other cell must not vanish: then the top wins even where rays passed the centre.
    scanned, mapped = heights_around(shown, points.cells, width)
    x, y = (points.sum(used * part) for part in ray)
    mapped = torch.where(lie_behind(x, y), mapped, UNSEEN)
    elsewhere = (scanned.amax(1) >= 0.5 * (middle + top)) | (mapped.amax(1) >= top - relief)
    ground = ground & elsewhere
    return points.spread_out(torch.where(ground, -1.0, 1.0).to(mean.dtype), torch.where(ground, bottom, top))


@step_side.register_fake
def _(cells: Tensor, slot: Tensor, z: Tensor, *others: Any) -> Tensor:
    return z.new_empty(2, *cells.shape)


def ends_of_step(
    points: Disputed, middle: Tensor, refinements: int, margin: float, min_extreme: int
) -> tuple[Tensor, Tensor]:
    """Return the heights (K,) of the step's top and bottom: the bottom is the top of the step upside down.

    The top is the mean of the points above the mean, repeated: each of the `refinements` halves the distance to the
    top of a wall's face. The bottom takes two. Up to `margin` standard deviations short of a level lies past it.
    A level that fewer than `min_extreme` reach, give or take a standard deviation, is an outlier's.
    """
    noise = points.spread.sqrt()
    widest = torch.where(points.weight > 0, noise, -torch.inf)

    def level(z: Tensor, height: Tensor, rounds: int) -> Tensor:
        past, reached = z + margin * noise, z + widest
        for _ in range(rounds):
            start = points.at_points(height)
            outer = points.weight * (past >= start)
            further = moved_by(height, points.sum(outer * (z - start)), points.sum(outer))
            there = (reached >= points.at_points(further)).to(height.dtype)
            height = torch.where(points.sum(there) >= min_extreme, further, height)
        return height

    return level(points.z, middle, refinements), -level(-points.z, -middle, 2)


def heights_around(layers: list[Tensor], cells: Tensor, width: int) -> list[Tensor]:
    """Read layers (B, C) at the eight neighbours of cells (K,) numbered across environments: each -> (K, 8)."""
    num_cells = layers[0].shape[1]
    i, j = cells % num_cells // width, cells % width
    di, dj = around(cells.device)
    i, j = i[:, None] + di, j[:, None] + dj
    exists = (i >= 0) & (i < num_cells // width) & (j >= 0) & (j < width)
    place = torch.where(exists, cells[:, None] + di * width + dj, 0)
    return [torch.where(exists, layer.take(place), UNSEEN) for layer in layers]


def lie_behind(x: Tensor, y: Tensor) -> Tensor:
    """Tell which neighbours (K, 8) of a cell lie behind it, within 50 degrees of where its rays (K,) go.

    Beside it along a wall lie cells that show the wall's face too, and the wall would end as every other cell's.
    """
    di, dj = (steps.to(x.dtype) for steps in around(x.device))
    limit = math.cos(math.radians(50)) * (di.square() + dj.square()).sqrt()
    along = x[:, None] * di + y[:, None] * dj
    return along > limit * (x.square() + y.square()).sqrt()[:, None]
