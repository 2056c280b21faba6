"""How the metrics read a map: fused from a recording, beside the truth, on a lattice fixed to the world."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks.quality.features.recordings import DT, SimulatedRun
from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap
from torchelev.grid import GridConfig
from torchelev.sim import Box
from torchelev.sim.steps import find_steps

GRID = GridConfig(resolution=0.04, length_x=10.0, length_y=10.0)
_HALF_WORLD = 400  # [cells] half the side of the lattice
Watch = Callable[[ElevationMap, int], None]
Figures = dict[str, float]


def fuse(recording: SimulatedRun, cfg: ElevationMapConfig, watch: Watch | None = None) -> ElevationMap:
    """Map a recording; call `watch` with the map and the scan's number after each scan."""
    emap = ElevationMap(cfg)
    for k, frame in enumerate(recording.frames):
        emap.update(frame.points, frame.T_map_sensor, frame.T_map_base, DT if k else 0.0)
        if watch is not None:
            watch(emap, k)
    return emap


class Cells(NamedTuple):
    """The cells of a map and their errors."""

    xy: Tensor  #: (H, W, 2) [m]
    elevation: Tensor  #: (H, W) [m], NaN where unknown
    error: Tensor  #: (H, W) [m], elevation minus truth


def cells_of(emap: ElevationMap, recording: SimulatedRun, k: int = -1) -> Cells:
    """Return the cells of a map, compared with the truth at scan k."""
    xy, elevation = emap.cell_centers()[0], emap.layer("elevation")[0].double()
    return Cells(xy, elevation, elevation - recording.truth(xy, k))


def world_index(xy: Tensor) -> tuple[Tensor, Tensor]:
    """Return the indices on the lattice of places (..., 2) [m]."""
    cell = torch.floor(xy / GRID.resolution).long() + _HALF_WORLD
    return cell[..., 0], cell[..., 1]


def blank_world() -> Tensor:
    """Return an empty mask on the lattice of cells that is fixed to the world, while the map's window moves."""
    return torch.zeros(2 * _HALF_WORLD, 2 * _HALF_WORLD, dtype=torch.bool)


def percent(part: Tensor, of: Tensor) -> float:
    """Return how many of the cells `of` are in `part` [%]; NaN if there are none."""
    total = int(of.sum())
    return 100 * (float((part & of).sum()) / total) if total else math.nan


def near_step(recording: SimulatedRun, xy: Tensor, k: int = -1) -> Tensor:
    """Return which places (..., 2) [m] have a step of more than 5 cm in the truth within 1.5 cells."""
    return find_steps(lambda places: recording.truth(places, k), xy, GRID.resolution, 0.05)


def hits(recording: SimulatedRun, wall: Box, above: float) -> Tensor:
    """Return on the lattice where exact returns hit the wall higher than `above` [m]."""
    hit = blank_world()
    for points in recording.exact:
        # Returns from a face lie on the border; the margin covers rounding.
        hit[world_index(points[on_wall(wall, points[:, :2], 1e-5) & (points[:, 2] > above), :2])] = True
    return hit


def on_wall(wall: Box, xy: Tensor, margin: float) -> Tensor:
    """Return which places (..., 2) [m] lie on a wall or within `margin` [m] of it along each axis."""
    low, high = torch.tensor(wall.low[:2]) - margin, torch.tensor(wall.high[:2]) + margin
    return ((xy >= low) & (xy <= high)).all(-1)
