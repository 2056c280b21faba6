"""Measure the error of the map's height against `drift.min_traversability`, with each traversability head.

    python -m training.traversability.drift_gate

Robots walk over simulated ground with odometry whose height drifts; the same recordings are mapped with each head and
each threshold. A map's error is the median over its cells of the elevation minus the true height, both relative to the
robot. Writes its root mean square and median over the maps [mm] to training/results/drift_gate.json.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from torchelev import ElevationMap, ElevationMapConfig, LearnedTraversabilityConfig, TraversabilityConfig
from torchelev.app.results import machine, markdown_table, write_json
from torchelev.robot import RobotConfig
from torchelev.sim import HeightField
from training import RESULTS
from training.traversability.maps.mapping import DataConfig, Look, map_config, tile_cell_centers, walk_and_look
from training.traversability.maps.terrain import KINDS, LENGTH, LOOK_INTERVAL, draw_robot, make_tiles

_THRESHOLDS = (0.0, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9)
RESOLUTION = 0.04  # [m]
_SEED = 77  # of recordings that no training uses
HEADS = ("analytic", "learned")


class SimulatedRun(NamedTuple):
    """What the robots of one batch see on their walk."""

    field: HeightField
    robot: RobotConfig
    looks: list[Look]


def _record(index: int) -> SimulatedRun:
    """Record a walk over two tiles of random kinds."""
    rng, cfg = np.random.default_rng([_SEED, index]), DataConfig()
    robot = draw_robot(rng)
    field = make_tiles([str(kind) for kind in rng.choice(list(KINDS), cfg.num_maps)], rng)
    return SimulatedRun(field, robot, list(walk_and_look(field, robot, cfg, rng)))


def _configuration(recording: SimulatedRun, head: str, threshold: float | None) -> ElevationMapConfig:
    """Return the default configuration with a head and a threshold; None: no drift compensation."""
    cfg = map_config(RESOLUTION, DataConfig().window)
    learned = LearnedTraversabilityConfig(robot=recording.robot)
    rating = learned if head == "learned" else TraversabilityConfig()
    assert cfg.drift is not None
    drift = None if threshold is None else dataclasses.replace(cfg.drift, min_traversability=threshold)
    return dataclasses.replace(cfg, traversability=rating, drift=drift)


def _height_errors(recording: SimulatedRun, cfg: ElevationMapConfig) -> Tensor:
    """Map a recording; return the error of each map [m], NaN for an empty one."""
    emap = ElevationMap(cfg, recording.field.num_tiles)
    for look in recording.looks:
        emap.update(look.points, look.T_map_sensor, look.T_map_base, LOOK_INTERVAL)
    T_tile_map = look.T_tile_base @ torch.linalg.inv(look.T_map_base)
    xy = tile_cell_centers(emap, T_tile_map)
    B, H, W, _ = xy.shape
    truth = recording.field.height(torch.arange(B), xy.float().flatten(1, 2)).view(B, H, W)
    z = emap.state.elevation.double() + T_tile_map[:, 2, 3, None, None]
    inside = emap.state.validity & (xy.abs().amax(-1) <= LENGTH / 2)
    return torch.where(inside, z - truth, torch.nan).flatten(1).nanmedian(1).values


@click.command(help=__doc__)
@click.option("--batches", type=click.IntRange(1), default=16, show_default=True, help="Recordings of two robots each.")
@click.option("--out", type=click.Path(path_type=Path), default=RESULTS / "drift_gate.json", help="JSON file to write.")
def main(batches: int, out: Path) -> None:
    """Measure, write JSON and print the table."""
    cases: list[tuple[str, float | None]] = [("none", None), *((head, t) for head in HEADS for t in _THRESHOLDS)]
    errors: dict[tuple[str, float | None], list[Tensor]] = {case: [] for case in cases}
    for index in tqdm(range(batches), unit="batch"):
        recording = _record(index)
        for head, threshold in cases:
            cfg = _configuration(recording, head, threshold)
            errors[head, threshold].append(_height_errors(recording, cfg))
    rows = []
    for (head, threshold), parts in errors.items():
        error = 1000 * torch.cat(parts)
        row: dict[str, Any] = {"head": head, "threshold": threshold, "rms_mm": float(error.square().nanmean().sqrt())}
        rows.append(row | {"median_mm": float(error.abs().nanmedian())})
    write_json(out, {"machine": machine(), "batches": batches, "resolution": RESOLUTION, "rows": rows})
    cells = [[r["head"], str(r["threshold"]), f"{r['rms_mm']:.1f}", f"{r['median_mm']:.1f}"] for r in rows]
    click.echo(markdown_table(["head", "threshold", "RMS [mm]", "median [mm]"], cells))


if __name__ == "__main__":
    main()
