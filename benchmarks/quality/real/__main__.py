"""Map real scans and compare the maps with points that were held out.

    python -m benchmarks.quality.real RECORDINGS_ROOT

RECORDINGS_ROOT holds `parked_car/`, two scans of one place, and `offroad/`, one scan and `driven_path.txt`: poses of
the same lidar along a path that the robot then drove. The code of the command line makes the maps. Prints a table and
writes benchmarks/results/real.json, which holds figures only and no data of the recordings.

Held out are the second scan of `parked_car` and a random tenth of the points of `offroad`, both without the points
above the exclusion ramp of their own sensor, which do not belong in a map of the ground.

Coverage is the fraction of the held-out points in the window whose cell is known.

A cell is flat if it holds at least 3 held-out points that span less than 10 cm in height. Only held-out points decide
this, so that no method chooses where it is measured.

The error is the absolute difference between a held-out point's height and its cell's.

On the driven path, the error is the absolute difference between a cell's height and that of the lidar above it minus
0.48 m. It is measured on the known cells under the straight lines between the poses, without those within 0.6 m of the
lidar at the time of the scan, where it saw the robot. Traversable is the fraction of these cells with a traversability
above 0.5, by the analytic head and by the learned one for its default robot.

The map is compared with the per-cell mean of all points of the same scan, which cannot distinguish ceilings and
trees from the ground, and with the per-cell mean of the points below the ramp.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch

from benchmarks import RESULTS
from benchmarks.quality.real.cases import Case, below_ramp, in_map, read_cases
from benchmarks.quality.real.metrics import (
    FLAT_POINTS,
    FLAT_SPAN,
    driven_figures,
    held_out_figures,
    mean_map,
    traversable_fraction,
)
from torchelev import LearnedTraversabilityConfig as Head
from torchelev.app.config_file import load_config
from torchelev.app.mapping.fuse_scans import MapOptions, fuse_all, new_map
from torchelev.app.results import markdown_table, write_json
from torchelev.io import MappingRun, base_poses
from torchelev.io.export import SavedMap, take

SIZE = 20.0  # [m] side of the maps
_REPEATS = 7  # of a mapping, for the median time


def _map(case: Case, head: Head | None = None, repeats: int = _REPEATS) -> tuple[SavedMap, float]:
    """Map a case like the command line; return the map and the median time of an update [ms]."""
    options = MapOptions(T_base_sensor=None, sensor_height=None, fixed=False)
    cfg = load_config(None, case.resolution, SIZE)
    cfg = cfg if head is None else replace(cfg, traversability=head)
    recording = case.recording.with_bases(base_poses(case.recording.T_map_sensor, None, None))
    times = []
    for _ in range(repeats):
        run = MappingRun(new_map(cfg, "cpu", options))
        stopped = fuse_all(run, recording, options)
        if stopped is not None:
            raise stopped
        times += run.update_ms
    return take(run.emap), float(np.median(times))


def _measure(case: Case) -> list[dict[str, Any]]:
    """Return a row for the map and one for each mean of the same points."""
    saved, ms = _map(case)
    scans = list(case.recording)
    maps = {
        "torchelev": saved.layers["elevation"],
        "mean of all points": mean_map(np.concatenate([in_map(frame) for frame in scans]), saved),
        "mean below the ramp": mean_map(np.concatenate([below_ramp(frame) for frame in scans]), saved),
    }
    rows = []
    for method, elevation in maps.items():
        row: dict[str, Any] = {"recording": case.name, "resolution_m": case.resolution, "method": method}
        row |= held_out_figures(elevation, case.held_out, saved)
        if case.driven is not None:
            row |= driven_figures(elevation, case.driven, saved)
        rows.append(row)
    rows[0]["ms_per_scan"] = ms
    if case.driven is not None:
        rows[0]["driven_traversable"] = traversable_fraction(saved, case.driven)
        learned, _ = _map(case, Head(), repeats=1)
        rows[0]["driven_traversable_learned"] = traversable_fraction(learned, case.driven)
    return rows


def _table(rows: list[dict[str, Any]]) -> str:
    """Tabulate the rows, lengths in centimeters."""
    head = ["recording", "cell", "method", "flat: median", "p90", "all: median", "p90", "coverage", "driven: median",
            "p90", "traversable", "learned", "ms/scan"]  # fmt: skip
    keys = ("flat_median_m", "flat_p90_m", "all_median_m", "all_p90_m")
    lines = []
    for row in rows:
        first = [row["recording"], f"{100 * row['resolution_m']:.0f} cm", row["method"]]
        driven = [_cm(row, "driven_median_m"), _cm(row, "driven_p90_m"), _percent(row, "driven_traversable")]
        driven.append(_percent(row, "driven_traversable_learned"))
        time = f"{row['ms_per_scan']:.1f}" if "ms_per_scan" in row else ""
        lines.append([*first, *(_cm(row, key) for key in keys), _percent(row, "coverage"), *driven, time])
    return markdown_table(head, lines)


def _cm(row: dict[str, Any], key: str) -> str:
    return f"{100 * row[key]:.1f} cm" if key in row else ""


def _percent(row: dict[str, Any], key: str) -> str:
    return f"{100 * row[key]:.1f} %" if key in row else ""


@click.command(help=__doc__)
@click.argument("recordings_root", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--threads", default=1, show_default=True, help="CPU threads.")
@click.option("--seed", default=0, show_default=True, help="Seed of the held-out points.")
@click.option("--out", type=click.Path(path_type=Path), default=RESULTS / "real.json", help="JSON file to write.")
def main(recordings_root: Path, threads: int, seed: int, out: Path) -> None:
    """Measure, print the table and write JSON."""
    torch.set_num_threads(threads)
    rows = [row for case in read_cases(recordings_root, seed) for row in _measure(case)]
    print(_table(rows))
    settings = {"size_m": SIZE, "seed": seed, "flat_span_m": FLAT_SPAN, "flat_points": FLAT_POINTS}
    write_json(out, {"settings": settings, "rows": rows})


if __name__ == "__main__":
    main()
