"""Real scans, split into robots whose heights are off, and merged into a site.

    python -m benchmarks.quality.real.merged RECORDINGS

Each of the two scans of `parked_car` is a robot, and each random quarter of the points of `offroad`. Offsets of up to
+-15 cm are added to their poses, and compared with the offsets that the site finds. Writes
benchmarks/results/real_merged.json.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks import RESULTS
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.app.results import markdown_table, write_json
from torchelev.io import Frame, open_recording
from torchelev.site import MergeReport, SiteMap

RESOLUTION, LENGTH, LARGEST = 0.1, 20.0, 0.15  # [m]


def split(frame: Frame, parts: int, seed: int = 0) -> list[Frame]:
    """Split a scan's points at random."""
    part = np.random.default_rng(seed).integers(parts, size=len(frame.points))
    return [frame._replace(points=frame.points[part == k]) for k in range(parts)]


def map_robots(frames: list[Frame], offsets: NDArray) -> ElevationMap:
    """Map each frame with a robot of its own, whose pose is too high by its offset [m]."""
    most = max(len(frame.points) for frame in frames)
    points = torch.full((len(frames), most, 3), torch.nan)
    poses = torch.stack([torch.from_numpy(frame.T_map_sensor).double() for frame in frames])
    for b, frame in enumerate(frames):
        points[b, : len(frame.points)] = torch.from_numpy(frame.points)
    poses[:, 2, 3] += torch.from_numpy(offsets)
    grid = GridConfig(resolution=RESOLUTION, length_x=LENGTH, length_y=LENGTH)
    emap = ElevationMap(ElevationMapConfig(grid=grid), num_envs=len(frames))
    center = torch.eye(4, dtype=torch.float64).expand(len(frames), 4, 4).clone()
    center[:, :3, 3] = poses[0, :3, 3]  # one window for all, so that cells can be compared
    emap.update(points, poses, center, dt=0.1)
    return emap


def seam(elevation: Tensor, offsets: NDArray | Tensor) -> float:
    """Return the median distance [m] of the heights of cells that two robots share, their offsets taken out."""
    heights = elevation - torch.as_tensor(offsets, dtype=elevation.dtype)[:, None, None]
    pairs = [(heights[a] - heights[b]).abs() for a in range(len(heights)) for b in range(a)]
    return float(torch.cat([pair[pair.isfinite()] for pair in pairs]).median())


def merge(frames: list[Frame], seed: int = 0) -> dict[str, Any]:
    """Merge robots with and without added offsets, and compare."""
    added = np.random.default_rng(seed).uniform(-LARGEST, LARGEST, len(frames))
    exact, off = map_robots(frames, np.zeros(len(frames))), map_robots(frames, added)
    reports: list[MergeReport] = []
    for emap in (exact, off):
        reports.append(SiteMap(RESOLUTION).merge(emap))
    error = (reports[1].offsets - reports[0].offsets).numpy() - (added - added.mean())
    elevation = off.layer("elevation")
    return {
        "robots": len(frames),
        "offset_error_max": float(np.abs(error).max()),
        "seam_before": seam(elevation, np.zeros(len(frames))),
        "seam_after": seam(elevation, reports[1].offsets),
        "seam_of_exact_poses": seam(exact.layer("elevation"), np.zeros(len(frames))),
        "cells": int(reports[1].new_cells.sum()),
        "contradictions": int(reports[1].contradictions.sum()),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Tabulate the rows, lengths in centimetres."""
    head = ["recording", "robots", "largest error of an added offset", "seam before", "after", "of the given poses"]
    names = ("seam_before", "seam_after", "seam_of_exact_poses")
    lines = []
    for row in rows:
        error = "below 0.01 mm" if row["offset_error_max"] < 1e-5 else f"{1e3 * row['offset_error_max']:.2f} mm"
        seams = [f"{100 * row[name]:.1f} cm" for name in names]
        lines.append([row["recording"], str(row["robots"]), error, *seams])
    return markdown_table(head, lines)


@click.command(help=__doc__)
@click.argument("recordings", type=click.Path(path_type=Path, exists=True))
def main(recordings: Path) -> None:
    """Merge all recordings."""
    car = list(open_recording(recordings / "parked_car"))
    field = open_recording(recordings / "offroad")[0]
    cases = {"parked_car": car, "offroad": split(field, 4)}
    rows = [{"recording": name, **merge(frames)} for name, frames in cases.items()]
    write_json(RESULTS / "real_merged.json", {"rows": rows})
    print(table(rows))


if __name__ == "__main__":
    main()
