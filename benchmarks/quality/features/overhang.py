"""The metric of the exclusion area."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.quality.features.reading import (
    GRID,
    Figures,
    blank_world,
    cells_of,
    fuse,
    on_wall,
    percent,
    world_index,
)
from benchmarks.quality.features.recordings import SimulatedRun
from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap
from torchelev.stages.measure.config import ExclusionConfig
from torchelev.stages.measure.stage import above_ramp


def overhang_cells(recording: SimulatedRun, cfg: ElevationMapConfig) -> tuple[Figures, ElevationMap]:
    """Measure what an overhanging bar and a ceiling leave in the map.

    Overhang cells are those with exact returns of bar or ceiling above the default ramp and with none below it.
    `overhang [%]`: how many of them were more than 10 cm above the ground after any scan.
    `bar at the end [%]`, `ceiling at the end [%]`: how many of the known cells under it are more than 10 cm too high in
    the last map, as in the figure, whether or not it was below the ramp at some scan. The bar, 0.35 m above the sensor,
    is below the ramp from more than 1.5 m away; its end at y > 0.65 is never closer than that.
    `obstacle mapped [%]`: how many of the cells that lie fully on the low obstacle's top and that an exact return hit
    are within 3 cm of it: the lower value of the last map before the robot is under the bar and the map at the end.
    """
    excluded, ever = _excluded_cells(recording), blank_world()
    obstacle = next(box for box in recording.scene.boxes if box.grounded)
    bar = recording.scene.boxes[0].low[0]
    mapped, hit = [], blank_world()

    def watch(emap: ElevationMap, k: int) -> None:
        cells = cells_of(emap, recording, k)
        ever[world_index(cells.xy)] |= cells.error > 0.1
        points = recording.exact[k]
        hit[world_index(points[(points[:, 2] - obstacle.high[2]).abs() < 1e-3, :2])] = True
        x = float(recording.T_true_sensor[k, 0, 3])
        if abs(x - (bar - 0.3)) < 0.07 or k == len(recording.frames) - 1:
            low, high = torch.tensor(obstacle.low[:2]) + 0.02, torch.tensor(obstacle.high[:2]) - 0.02
            inside = ((cells.xy > low) & (cells.xy < high)).all(-1) & hit[world_index(cells.xy)]
            mapped.append(percent(cells.error.abs() <= 0.03, inside))

    emap = fuse(recording, cfg, watch)
    cells = cells_of(emap, recording)
    high, known = cells.error > 0.1, cells.error.isfinite()
    under = [on_wall(box, cells.xy, GRID.resolution / 2) & known for box in recording.scene.boxes[:2]]
    return {
        "overhang [%]": percent(ever, excluded),
        "bar at the end [%]": percent(high, under[0]),
        "ceiling at the end [%]": percent(high, under[1]),
        "obstacle mapped [%]": min(mapped),
        "cells": float(excluded.sum()),
    }, emap


def _excluded_cells(recording: SimulatedRun) -> Tensor:
    """Return on the lattice the cells whose overhang was only seen above the default ramp."""
    above, below = blank_world(), blank_world()
    for k, points in enumerate(recording.exact):
        points = points[points.isfinite().all(-1)]
        overhang = points[:, 2] > recording.truth(points[:, :2], k) + 0.1
        is_above = above_ramp(points - recording.T_true_sensor[k, :3, 3], ExclusionConfig())
        above[world_index(points[overhang & is_above, :2])] = True
        below[world_index(points[overhang & ~is_above, :2])] = True
    return above & ~below
