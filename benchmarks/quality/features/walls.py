"""The metric of edges."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.quality.features.reading import (
    GRID,
    Cells,
    Figures,
    cells_of,
    fuse,
    hits,
    on_wall,
    world_index,
)
from benchmarks.quality.features.recordings import SimulatedRun
from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap
from torchelev.sim import Box


def wall_tops(recording: SimulatedRun, cfg: ElevationMapConfig) -> tuple[Figures, ElevationMap]:
    """Measure the height of walls: one of 0.5 m whose top is seen, and one of 1 m of which only the face is seen.

    A row is the line of cells across a wall that touch it, except within 8 cm of the ends of its pieces, where an exact
    return hit the wall within 2 cm of its top. The row's height is that of its highest known cell.
    `wall top [cm]`, `tall wall top [cm]`: 90th percentile over rows of the absolute difference from the wall's height;
    `wall rows off by 2 cm [%]`, `tall wall rows off by 2 cm [%]`: how many rows differ by more than 2 cm.
    `top cells [cm]`: 90th percentile of the absolute error of the cells whose center is on the 0.5 m wall and whose top
    an exact return hit; `off by 5 cm [%]`: how many of these differ by more than 5 cm.
    """
    emap = fuse(recording, cfg)
    cells = cells_of(emap, recording)
    low_wall, tall_wall = recording.scene.boxes[:4], recording.scene.boxes[4:8]
    top = torch.cat([_top_errors(recording, cells, piece) for piece in low_wall])
    low = torch.cat([_row_errors(recording, cells, piece) for piece in low_wall])
    tall = torch.cat([_row_errors(recording, cells, piece) for piece in tall_wall])
    return {
        "wall top [cm]": 100 * float(low.quantile(0.9)),
        "wall rows off by 2 cm [%]": 100 * float((low > 0.02).double().mean()),
        "tall wall top [cm]": 100 * float(tall.quantile(0.9)),
        "tall wall rows off by 2 cm [%]": 100 * float((tall > 0.02).double().mean()),
        "tall wall rows": float(len(tall)),
        "top cells [cm]": 100 * float(top.quantile(0.9)),
        "off by 5 cm [%]": 100 * float((top > 0.05).double().mean()),
        "top cells": float(len(top)),
    }, emap


def _top_errors(recording: SimulatedRun, cells: Cells, wall: Box) -> Tensor:
    """Return the absolute errors [m] of the known cells whose center is on the wall and whose top a return hit."""
    hit = hits(recording, wall, wall.high[2] - 1e-3)[world_index(cells.xy)]
    return cells.error[on_wall(wall, cells.xy, 0.0) & hit & cells.error.isfinite()].abs()


def _row_errors(recording: SimulatedRun, cells: Cells, wall: Box) -> Tensor:
    """Return how far the height of each row of cells across the wall is from the wall's height [m]."""
    y = cells.xy[..., 1]
    along = (y > wall.low[1] + 0.08) & (y < wall.high[1] - 0.08)
    touching = on_wall(wall, cells.xy, GRID.resolution / 2) & along
    seen = (touching & hits(recording, wall, wall.high[2] - 0.02)[world_index(cells.xy)]).any(0)
    height = cells.elevation.nan_to_num(nan=-math.inf).masked_fill(~touching, -math.inf).amax(0)
    return (height.clamp(min=0.0) - wall.high[2]).abs()[seen]
