"""Real scans, completed from a part and scored where the rest has measured.

    python -m benchmarks.quality.real.completed RECORDINGS

`parked_car`: the first scan is completed and scored on the cells that the second measures and the first does not.
`offroad`: a tenth of the points is completed and scored on the cells of the others. Scores are beside those of the
in-painting filters. Writes benchmarks/results/real_completed.json.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import torch
from torch import Tensor

from benchmarks import RESULTS
from benchmarks.quality.real.merged import split
from torchelev import CompletionConfig, ElevationMap, ElevationMapConfig, GridConfig
from torchelev.app.results import markdown_table, write_json
from torchelev.filters import Filter
from torchelev.io import Frame, open_recording

RESOLUTION, LENGTH = 0.1, 20.0  # [m]
FILLS = ("inpaint_minimum", "inpaint_nearest", "inpaint_diffusion", "inpaint_telea", "inpaint_navier_stokes")
NEAREST = "inpaint_nearest"


def map_frames(frames: list[Frame], center: Tensor) -> ElevationMap:
    """Map frames one after the other, in a window around a place."""
    grid = GridConfig(resolution=RESOLUTION, length_x=LENGTH, length_y=LENGTH)
    emap = ElevationMap(ElevationMapConfig(grid=grid, completion=CompletionConfig()))
    for frame in frames:
        pose = torch.from_numpy(frame.T_map_sensor).double()[None]
        emap.update(torch.from_numpy(frame.points)[None], pose, center[None], dt=0.1)
    return emap


@torch.no_grad()
def score(seen: list[Frame], later: list[Frame]) -> dict[str, Any]:
    """Return the mean absolute errors [m] of each answer on cells that only the later frames measure."""
    center = torch.eye(4, dtype=torch.float64)
    center[:3, 3] = torch.from_numpy(seen[0].T_map_sensor[:3, 3])
    emap, truth = map_frames(seen, center), map_frames(later, center)
    layer = emap.read_layer("elevation")
    counts = truth.state.validity & ~layer[1]
    height = truth.state.elevation[counts]
    near, _ = Filter(NEAREST)(layer, resolution=RESOLUTION)
    result: dict[str, Any] = {"cells": int(counts.sum()), "known": int(layer[1].sum())}
    for name in FILLS:
        values, known = Filter(name)(layer, resolution=RESOLUTION)
        result[name] = float((torch.where(known, values, near)[counts] - height).abs().mean())
    error = (emap.layer("completed")[counts] - height).abs()
    within = error <= 2 * emap.layer("completed_std")[counts]
    return result | {"completed": float(error.mean()), "within_2_std": float(within.float().mean())}


def table(rows: list[dict[str, Any]]) -> str:
    """Tabulate the mean absolute errors [cm]."""
    head = ["recording", "known cells", "scored cells", "completed", *FILLS, "within 2 std [%]"]
    lines = []
    for row in rows:
        errors = [f"{100 * row[name]:.1f}" for name in ("completed", *FILLS)]
        counts = [f"{row[name]:,}" for name in ("known", "cells")]
        lines.append([row["recording"], *counts, *errors, f"{100 * row['within_2_std']:.0f}"])
    return markdown_table(head, lines)


@click.command(help=__doc__)
@click.argument("recordings", type=click.Path(path_type=Path, exists=True))
def main(recordings: Path) -> None:
    """Complete all recordings."""
    car = list(open_recording(recordings / "parked_car"))
    field = split(open_recording(recordings / "offroad")[0], 10)
    cases = {"parked_car": (car[:1], car[1:]), "offroad": (field[:1], field[1:])}
    rows = [{"recording": name, **score(*frames)} for name, frames in cases.items()]
    write_json(RESULTS / "real_completed.json", {"rows": rows})
    click.echo(table(rows))


if __name__ == "__main__":
    main()
