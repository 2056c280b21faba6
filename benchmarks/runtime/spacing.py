"""What a policy that was trained on points 0.1 m apart reads of maps with other cells.

Walks through four scenes, with the noise of a depth camera. At each scan after the tenth the 187 points of a grid scan
are read and compared with the true heights at these points; unknown ones do not count.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.quality.accuracy.recordings import SimulatedRun, corrupt, record
from benchmarks.runtime.build import machine
from torchelev import ElevationMap, ElevationMapConfig, GridConfig, HeightScan
from torchelev.app.results import markdown_table
from torchelev.inputs.clouds import height_map_to_points

_SCENES = ("rough", "stairs", "boxes", "mixed")
_FIRST = 10
_SIZE = 8.0  # [m]
_GO2_CELLS, _GO2_RESOLUTION = 128, 0.06  # [m]
Read = Callable[[SimulatedRun], list[Tensor]]


def measure() -> dict[str, Any]:
    """Return a row for each way to read: errors in cm over all scenes."""
    rows = {}
    for name, read in tqdm(_WAYS.items(), desc="ways"):
        errors = torch.cat([error for scene in _SCENES for error in read(record(scene, "walk"))])
        size = 100 * errors[errors.isfinite()].abs()
        rows[name] = {
            "rmse": float(size.square().mean().sqrt()),
            "p95": float(size.quantile(0.95)),
            "known": len(size) / len(errors),
        }
    return {**machine(), "rows": rows}


def table(result: dict[str, Any]) -> str:
    """Tabulate the errors by way to read."""
    lines = [
        [name, f"{row['rmse']:.1f}", f"{row['p95']:.1f}", f"{100 * row['known']:.0f}"]
        for name, row in result["rows"].items()
    ]
    return markdown_table(["read", "RMSE [cm]", "95 % of errors below [cm]", "known [%]"], lines)


def _from_camera(resolution: float, mode: str, spacing: float, run: SimulatedRun) -> list[Tensor]:
    """Map the scans, and read points so far apart as if they were 0.1 m apart."""
    emap = ElevationMap(ElevationMapConfig(grid=GridConfig(resolution=resolution, length_x=_SIZE, length_y=_SIZE)))
    size: Any = {"length_x": 16 * spacing, "length_y": 10 * spacing, "resolution": spacing}
    scan, errors = HeightScan.grid(mode=mode, **size), []
    for k, points in enumerate(corrupt(run, "noisy")):
        base = run.T_map_base[k, None]
        emap.update(points[None], run.T_map_sensor[k, None], base, 0.1)
        if k >= _FIRST:
            errors.append(_errors(run, emap, scan, base))
    return errors


def _from_height_map(resolution: float, run: SimulatedRun) -> list[Tensor]:
    """Map the height maps that a robot sends, of true heights, and read the points."""
    grid = GridConfig(resolution=resolution, length_x=72 * resolution, length_y=72 * resolution)
    emap, scan, errors = ElevationMap(ElevationMapConfig(grid=grid, raycast=None)), HeightScan.grid(), []
    steps = _GO2_RESOLUTION * (torch.arange(_GO2_CELLS).double() - _GO2_CELLS / 2)
    for k in range(_FIRST, len(run.T_map_base)):
        base, T = run.T_map_base[k, None], torch.eye(4, dtype=torch.float64)[None]
        T[0, :3, 3] = base[0, :3, 3]
        xy = torch.stack(torch.meshgrid(steps + T[0, 0, 3], steps + T[0, 1, 3], indexing="xy"), -1)
        points = height_map_to_points(run.scene.truth(xy), _GO2_RESOLUTION, tuple(xy[0, 0].tolist()))
        points = (points - T[0, :3, 3]).float()[None]
        emap.update(points, T, base, 0.1, variance=torch.full((1, points.shape[1]), 1e-4))
        errors.append(_errors(run, emap, scan, base))
    return errors


def _errors(run: SimulatedRun, emap: ElevationMap, scan: HeightScan, base: Tensor) -> Tensor:
    """Return the errors [m] of a scan's heights at points 0.1 m apart, NaN where unknown."""
    values, known = scan(emap, base)
    truth = run.scene.truth(HeightScan.grid().xy(base)[0])
    return torch.where(known[0], base[0, 2, 3] - values[0] - truth, torch.nan)


_WAYS: dict[str, Read] = {
    **{
        f"cells of {100 * size:g} cm, {mode}": partial(_from_camera, size, mode, 0.1)
        for size in (0.1, 0.05, 0.04, 0.02)
        for mode in ("bilinear", "nearest")
    },
    "height map of 128 × 128 cells of 6 cm, in cells of 6 cm": partial(_from_height_map, 0.06),
    "height map of 128 × 128 cells of 6 cm, in cells of 5 cm": partial(_from_height_map, 0.05),
    "cells of 5 cm, 17 × 11 of them as if 10 cm apart": partial(_from_camera, 0.05, "nearest", 0.05),
}
