"""Does the truth lie within two standard deviations of the map, where poses are uncertain?

    python -m benchmarks.quality.pose_covariance

Robots walk 2 m with a depth camera and poses that drift by each preset of `torchelev.sim`, with `pose_covariance` and
without. Counted are well-observed cells, those that at least 10 points support. Writes
benchmarks/results/pose_covariance.json.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import click
import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks import RESULTS
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.app.results import markdown_table, write_json
from torchelev.sim import (
    DepthCamera,
    MountedSensor,
    PoseErrors,
    SensorErrorConfig,
    SensorErrors,
    Terrain,
    make_terrain,
    mount,
    preset,
)

PRESETS = ("perfect", "miki_2022", "ame_2", "leg_odometry")  # the others have exact poses
KINDS = ("flat", "slope", "rough", "stairs_up")
GRID = GridConfig(resolution=0.04, length_x=4.0, length_y=4.0)
_STEP, _DT, _HEIGHT = 0.05, 0.1, 0.5  # [m] of a scan's way, [s] between scans, [m] of the base above the ground
_SUPPORT = 10  # points of a well-observed cell


class Shares(NamedTuple):
    """Of the well-observed cells of many robots."""

    inside: float  #: share with the truth within two standard deviations
    error: float  #: [m] median
    std: float  #: [m] median standard deviation


def walk(kind: str, pose_preset: str, with_covariance: bool, num_envs: int, steps: int, seed: int) -> Shares:
    """Map a walk over tiles of rising difficulty and compare the map with the ground."""
    terrain = make_terrain(kind, torch.linspace(0.0, 0.6, num_envs), length=16.0, seed=seed)
    emap, camera = ElevationMap(ElevationMapConfig(grid=GRID), num_envs), MountedSensor(DepthCamera(48, 36), mount())
    pose_errors = PoseErrors(preset(pose_preset).pose, num_envs, seed=seed)
    sensor_errors = SensorErrors(_sensor_errors(), num_envs, seed=seed)
    tiles = torch.arange(num_envs)
    for k in range(steps):
        T_map_base = _pose(terrain, tiles, -2.0 + _STEP * k)
        points = sensor_errors(camera(terrain.field, tiles, T_map_base)).points
        estimated = pose_errors(T_map_base, dt=_DT)
        covariance = pose_errors.covariance if with_covariance else None
        emap.update(points, estimated @ mount(), estimated, dt=_DT, pose_covariance=covariance)
    return _score(emap, terrain, tiles)


def _sensor_errors() -> SensorErrorConfig:
    """Return those of a depth camera whose place and time are exact: else they would act as errors of the pose."""
    cfg = preset("depth_camera").sensor
    assert isinstance(cfg, SensorErrorConfig)
    return dataclasses.replace(cfg, latency=0, missed_frames=0.0, mounting_position=0.0, mounting_rotation_deg=0.0)


def _pose(terrain: Terrain, tiles: Tensor, x: float) -> Tensor:
    """Return the poses of robots that stand level at x on the middle of their tiles."""
    T_map_base = torch.eye(4, dtype=torch.float64).repeat(len(tiles), 1, 1)
    T_map_base[:, 0, 3] = x
    T_map_base[:, 2, 3] = terrain.truth(tiles, T_map_base[:, None, :2, 3].float())[:, 0] + _HEIGHT
    return T_map_base


def _score(emap: ElevationMap, terrain: Terrain, tiles: Tensor) -> Shares:
    """Compare the well-observed cells with the ground."""
    truth = terrain.truth(tiles, emap.cell_centers().flatten(1, 2)).view(emap.elevation.shape)
    elevation, std = emap.layer("elevation"), emap.layer("variance").sqrt()
    counts = torch.isfinite(elevation) & (emap.state.support >= _SUPPORT)
    error, std = (elevation - truth).abs()[counts], std[counts]
    return Shares(float((error <= 2 * std).float().mean()), float(error.median()), float(std.median()))


def measure(num_envs: int, steps: int, seeds: int) -> list[dict[str, Any]]:
    """Walk over each kind of ground with each preset, with the covariance and without; mean of the seeds."""
    cases = [(name, kind) for name in PRESETS for kind in KINDS]
    rows = []
    for name, kind in tqdm(cases, unit="case", disable=None):
        row: dict[str, Any] = {"preset": name, "ground": kind}
        for key, with_covariance in (("with", True), ("without", False)):
            shares = [walk(kind, name, with_covariance, num_envs, steps, seed) for seed in range(seeds)]
            row[key] = {f: sum(getattr(s, f) for s in shares) / seeds for f in Shares._fields}
        rows.append(row)
    return rows


def table(result: dict[str, Any]) -> str:
    """Tabulate the shares, with the covariance and without."""
    head = ["pose errors", "ground", "within ± 2 σ", "median error [mm]", "median σ [mm]", "without", "σ without [mm]"]
    rows = []
    for row in result["rows"]:
        given, withheld = row["with"], row["without"]
        cells = [f"{100 * given['inside']:.1f} %", f"{1e3 * given['error']:.1f}", f"{1e3 * given['std']:.1f}"]
        cells += [f"{100 * withheld['inside']:.1f} %", f"{1e3 * withheld['std']:.1f}"]
        rows.append([row["preset"], row["ground"], *cells])
    return markdown_table(head, rows)


@click.command(help=__doc__)
@click.option("--num-envs", default=128, show_default=True, help="Robots of each case.")
@click.option("--steps", default=40, show_default=True, help="Scans of each robot.")
@click.option("--seeds", default=1, show_default=True, help="Repetitions with other errors and ground.")
def main(num_envs: int, steps: int, seeds: int) -> None:
    """Measure, write the JSON and print the table."""
    config = {"num_envs": num_envs, "steps": steps, "seeds": seeds, "support": _SUPPORT}
    result = {"config": config, "rows": measure(num_envs, steps, seeds)}
    write_json(RESULTS / "pose_covariance.json", result)
    click.echo(table(result))


if __name__ == "__main__":
    main()
