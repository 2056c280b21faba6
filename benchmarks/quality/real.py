"""Map real recordings with the command line's code and measure the maps against points they never saw.

    python -m benchmarks.quality.real RECORDINGS_ROOT

RECORDINGS_ROOT holds `parked_car/` (two scans of one place) and `offroad/` (one scan, and `driven_path.txt`: poses of
the same lidar along a path that the robot then drove). Prints a markdown table and writes `results/real.json`, which
holds figures only, no data of the recordings.

Held out: of `parked_car` the whole second scan; of `offroad` a random tenth of the points. Both less what lies above
the exclusion ramp as seen from their own sensor, since a map of the ground shall not hold it.

coverage   share of held-out points in the window whose cell is known
flat cell  at least 3 held-out points that span less than 10 cm in height: told by the held-out points alone, so that
           no method chooses where it is judged
error      |height of the cell that holds the point - height of the point|, over held-out points on known flat cells
driven     |height of the cell - (height of the lidar that passed over it - 0.48 m)|, over the known cells below the
           straight lines between the poses of the path, less those within 0.6 m of the lidar at the time of the scan,
           where it saw the robot itself; traversable: share of these cells with a traversability above 0.5, by the
           analytic head and by the learned one for its default robot

Beside the map stand the per-cell mean of all points of the same scan, which knows no ceiling and no tree from the
ground, and the per-cell mean of its points below the ramp.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from numpy.typing import NDArray

from torchelev import LearnedTraversabilityConfig as Head
from torchelev.app.config_file import load_config
from torchelev.app.map_command import MapOptions, fuse_all, new_map
from torchelev.app.results import markdown_table, write_json
from torchelev.io import Frame, MappingRun, Recording, open_recording, read_poses
from torchelev.io.export import SavedMap, take
from torchelev.stages.measure import ExclusionConfig, above_ramp

RESULTS = Path(__file__).parents[1] / "results" / "real.json"
LIDAR_HEIGHT = 0.48  # [m] of the lidar of `offroad` above the ground it drove over, from the recording's own notes
ROBOT_RADIUS = 0.6  # [m] around the lidar of `offroad`
SIZE = 20.0  # [m]
FLAT_SPAN, FLAT_POINTS = 0.10, 3
REPEATS = 7  # of a mapping, for its time


@dataclass(frozen=True)
class Case:
    """A recording, what of it is mapped, and what is held out (N, 3) [m] in the map frame."""

    name: str
    recording: Recording
    held_out: NDArray
    resolution: float
    driven: NDArray | None = None  # (T, 3) [m] where the lidar went, inside the window


class OneScan(Recording):
    """A recording of one scan, already read."""

    def __init__(self, frame: Frame) -> None:
        super().__init__([Path(frame.name)], frame.T_map_sensor[None], np.zeros(1), lambda path: frame.points)


def main_cases(root: Path, seed: int) -> list[Case]:
    """The recordings under `root`, split into what is mapped and what is held out."""
    car = open_recording(root / "parked_car")
    field = open_recording(root / "offroad")[0]
    chosen = np.random.default_rng(seed).random(len(field.points)) < 0.1
    mapped = OneScan(field._replace(points=field.points[~chosen]))
    driven = along(read_poses(root / "offroad" / "driven_path.txt").T_map_sensor[:, :3, 3], step=0.02)
    driven = driven[np.linalg.norm((driven - field.T_map_sensor[:3, 3])[:, :2], axis=1) > ROBOT_RADIUS]
    second, tenth = below_ramp(car[1]), below_ramp(field._replace(points=field.points[chosen]))
    return [
        Case("parked_car", car[:1], second, 0.2),
        Case("parked_car", car[:1], second, 0.1),
        Case("offroad", mapped, tenth, 0.1, driven),
    ]


def along(path: NDArray, step: float) -> NDArray:
    """Points every `step` [m] on the straight lines between the poses of a path (T, 3) [m]."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.arange(0.0, way[-1], step)
    return np.stack([np.interp(at, way, path[:, axis]) for axis in range(3)], axis=-1)


def in_map(frame: Frame) -> NDArray:
    """Points of a frame (N, 3) [m] in the map frame."""
    return frame.points @ frame.T_map_sensor[:3, :3].T + frame.T_map_sensor[:3, 3]


def below_ramp(frame: Frame) -> NDArray:
    """Points of a frame (N, 3) [m] in the map frame, less those in the exclusion area."""
    points = in_map(frame)
    relative = torch.from_numpy(points - frame.T_map_sensor[:3, 3])
    return points[~above_ramp(relative, ExclusionConfig()).numpy()]


def map_it(case: Case, head: Head | None = None, repeats: int = REPEATS) -> tuple[SavedMap, float]:
    """Map a case as the command line would; return the map and the median time [ms] of a scan's update."""
    options = MapOptions(T_base_sensor=None, sensor_height=None, fixed=False)
    cfg = load_config(None, case.resolution, SIZE)
    cfg = cfg if head is None else replace(cfg, traversability=head)
    times = []
    for _ in range(repeats):
        run = MappingRun(new_map(cfg, "cpu", options))
        stopped = fuse_all(run, case.recording, options)
        if stopped is not None:
            raise stopped
        times += run.update_ms
    return take(run.emap), float(np.median(times))


def cells_of(points: NDArray, saved: SavedMap) -> tuple[NDArray, NDArray]:
    """Flat cell numbers (N,) of points, and which of them lie in the window."""
    shape = np.array(saved.layers["elevation"].shape)
    ij = np.floor((points[:, :2] - saved.center[:2]) / saved.resolution + shape / 2).astype(int)
    inside = np.all((ij >= 0) & (ij < shape), axis=1)
    return np.where(inside, ij[:, 0] * shape[1] + ij[:, 1], 0), inside


def mean_map(points: NDArray, saved: SavedMap) -> NDArray:
    """Per-cell mean height (H, W) [m] on the same grid, NaN where there is no point."""
    cells, inside = cells_of(points, saved)
    size = saved.layers["elevation"].size
    count = np.bincount(cells[inside], minlength=size)
    total = np.bincount(cells[inside], points[inside, 2], minlength=size)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(saved.layers["elevation"].shape)


def flat_points(points: NDArray, saved: SavedMap) -> NDArray:
    """Tell which points (N,) lie on flat cells."""
    cells, inside = cells_of(points, saved)
    low, high = (np.full(saved.layers["elevation"].size, v) for v in (np.inf, -np.inf))
    np.minimum.at(low, cells[inside], points[inside, 2])
    np.maximum.at(high, cells[inside], points[inside, 2])
    count = np.bincount(cells[inside], minlength=low.size)
    flat: NDArray = (high - low < FLAT_SPAN) & (count >= FLAT_POINTS)
    return inside & flat[cells]


def held_out_figures(elevation: NDArray, points: NDArray, saved: SavedMap) -> dict[str, float]:
    """Coverage and |error| [m] of an elevation (H, W) at held-out points."""
    cells, inside = cells_of(points, saved)
    value = elevation.ravel()[cells]
    known = inside & np.isfinite(value)
    error = np.abs(value - points[:, 2])
    flat = error[known & flat_points(points, saved)]
    return {
        "coverage": float(known.sum() / inside.sum()),
        "flat_median_m": float(np.median(flat)),
        "flat_p90_m": float(np.percentile(flat, 90)),
        "flat_points": len(flat),
        "all_median_m": float(np.median(error[known])),
        "all_p90_m": float(np.percentile(error[known], 90)),
    }


def driven_figures(elevation: NDArray, driven: NDArray, saved: SavedMap) -> dict[str, float]:
    """|height - (lidar's height - 0.48 m)| [m] at the cells that the robot drove over, each counted once."""
    cell = np.unique(cells_of(driven, saved)[0])
    ground = mean_map(driven, saved).ravel()[cell] - LIDAR_HEIGHT
    value = elevation.ravel()[cell]
    known = np.isfinite(value)
    error = np.abs(value - ground)[known]
    return {
        "driven_cells": len(cell),
        "driven_coverage": float(known.mean()),
        "driven_median_m": float(np.median(error)),
        "driven_p90_m": float(np.percentile(error, 90)),
    }


def traversable_share(saved: SavedMap, driven: NDArray) -> float:
    """Share of the driven cells with a known traversability for which it is above one half."""
    value = saved.layers["traversability"].ravel()[np.unique(cells_of(driven, saved)[0])]
    return float((value[np.isfinite(value)] > 0.5).mean())


def measure_case(case: Case) -> list[dict[str, Any]]:
    """One row for the map and one for each mean of the same points."""
    saved, ms = map_it(case)
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
        rows[0]["driven_traversable"] = traversable_share(saved, case.driven)
        learned, _ = map_it(case, Head(), repeats=1)
        rows[0]["driven_traversable_learned"] = traversable_share(learned, case.driven)
    return rows


def markdown(rows: list[dict[str, Any]]) -> str:
    """The table, lengths in centimetres."""
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


@click.command(help=__doc__.split("\n")[0])
@click.argument("recordings_root", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--threads", default=1, show_default=True, help="CPU threads of torch.")
@click.option("--seed", default=0, show_default=True, help="Of the points held out of a single scan.")
@click.option("--out", type=click.Path(path_type=Path), default=RESULTS, show_default=True, help="JSON to write.")
def main(recordings_root: Path, threads: int, seed: int, out: Path) -> None:
    torch.set_num_threads(threads)
    rows = [row for case in main_cases(recordings_root, seed) for row in measure_case(case)]
    print(markdown(rows))
    settings = {"size_m": SIZE, "seed": seed, "flat_span_m": FLAT_SPAN, "flat_points": FLAT_POINTS}
    write_json(out, {"settings": settings, "rows": rows})


if __name__ == "__main__":
    main()
