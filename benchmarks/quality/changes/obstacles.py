"""After how many scans new obstacles and plates show in the map."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from benchmarks.quality.changes.world import GRID, HALF_CELL, OBSTACLES, World
from torchelev import AgingConfig
from torchelev.grid import locate
from torchelev.sim import Boxes, MountedSensor
from torchelev.stages.cells import PointCells

SETTLED = 600  # scans of empty ground before an obstacle, at 10 Hz
WATCHED = 40  # scans with the obstacle
# Fractions of the points that are kept: about 2 or 0.5 points per cell.
FRACTIONS = {"box": (1.0,), "person": (0.15, 0.03), "wall": (0.12, 0.03)}
_PLATE = (0.15, 0.15, 0.015)  # [m] half sizes
RATES = (1e-7, 1e-5, 1e-4, 1e-3)  # [m^2/s] variance rates of aging; the first is the default


def obstacle_scans(
    sensor: MountedSensor,
    obstacle: str,
    fraction: float,
    seeds: int,
    settled: int,
    compiled: bool,
    watched: int = WATCHED,
) -> dict[str, Any]:
    """Return after how many scans half of the hit cells show the obstacle, and the points per hit cell and scan."""
    world = World(sensor, seeds, compiled)
    for _ in range(settled):
        world.scan(None, 0.1, fraction)
    boxes = world.ahead(OBSTACLES[obstacle])
    points, shown = torch.zeros_like(world.emap.state.elevation), []
    for _ in range(watched):
        points += hits(world, world.scan(boxes, 0.1, fraction), boxes)
        hit = points > 0
        shows = hit & (world.above_ground() > 0.15)
        shown.append(2 * shows.sum((1, 2)) >= hit.sum((1, 2)).clamp(min=1))
    return scans_until(shown) | {"points": float(points[points > 0].median()) / watched}


def scans_until(shown: list[Tensor]) -> dict[str, int]:
    """Return median and maximum over robots of the number of scans until a mask (B,) is true.

    A robot for which none is true counts as one scan more than there are.
    """
    padded = torch.stack([*shown, torch.ones_like(shown[0])])
    scans = (padded.int().argmax(0) + 1).sort().values
    return {"median": int(scans[len(scans) // 2]), "most": int(scans[-1])}


def hits(world: World, points: Tensor, boxes: Boxes, above: float = 0.05, beside: float = HALF_CELL) -> Tensor:
    """Count the points on the obstacle in each cell (B, H, W).

    Args:
        world: the robots.
        points: (B, N, 3) [m], map frame.
        boxes: the obstacle of each robot.
        above: height above the ground from which points count [m].
        beside: largest distance of a cell's center from the obstacle [m]; 0 counts the covered centers only.
    """
    xy, z = points[..., :2].nan_to_num(), points[..., 2]
    is_high = z > world.field.height(world.tiles, xy) + above
    offset = -world.emap.state.corner * GRID.resolution
    slot, inside = locate(xy[..., 0], xy[..., 1], offset, GRID)
    (count,) = PointCells(slot.long(), inside, GRID.num_cells).sums((is_high & inside).float())
    place, half = boxes.T_map_box[:, 0, :2, 3], boxes.half_size[:, 0, :2] + beside
    covered = ((world.emap.cell_centers() - place[:, None, None]).abs() < half[:, None, None]).all(-1)
    return count.view_as(world.emap.state.elevation) * covered


def plate_scans(
    sensor: MountedSensor, rate: float, seeds: int, settled: int, compiled: bool, watched: int = WATCHED
) -> dict[str, Any]:
    """Return after how many scans a plate shows to 80 % of its height, and the RMSE of the ground before [mm].

    The ground is flat, so that all of the plate lies above it.
    """
    world = World(sensor, seeds, compiled, amplitude=0.0, aging=AgingConfig(variance_rate=rate))
    for _ in range(settled):
        world.scan(None, 0.1)
    boxes, flat = world.ahead(_PLATE), world.above_ground()
    hit, shown = torch.zeros_like(world.emap.state.validity), []
    for _ in range(watched):
        hit |= hits(world, world.scan(boxes, 0.1), boxes, above=0.0, beside=0.0) > 0
        shown.append(torch.where(hit, world.above_ground(), math.nan).nanmean((1, 2)) >= 0.8 * 2 * _PLATE[2])
    return scans_until(shown) | {"rmse_mm": 1e3 * float(flat[hit].square().nanmean().sqrt())}
