"""Time what perception costs in the training of a policy.

    python -m benchmarks.speed.sight
    python -m benchmarks.speed.sight --scans 4096    # height scans beside a bare gather; writes nothing

Times the parts of a step of TerrainNav with 256 robots and two cameras of 256 rays each, and whole steps with the map,
with the true ground and blind. Writes benchmarks/results/sight.json. With `--scans`: scans of 187 points of so many
robots, by preset and fill, beside `torch.gather` of the cells below the points.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import click
import torch
from torch import Tensor

from benchmarks import RESULTS
from benchmarks.speed.common.meter import interleaved
from benchmarks.speed.common.workload import MANY_POINTS, Drive, full_config
from envs.terrain_nav import TerrainNav
from envs.terrain_nav.sight import MapSight
from envs.terrain_nav.task import NUM_ACTIONS
from torchelev import ElevationMap, HeightScan
from torchelev.app.results import markdown_table, write_json
from torchelev.observations.fill import FILLS, ORIGINAL
from torchelev.observations.scan.presets import PRESETS
from torchelev.state import map_layers

NUM_ENVS = 256


def _step(task: TerrainNav) -> Callable[[], Any]:
    """Return a whole step as a call: random actions, reset of finished episodes, sensing, observation."""
    generator = torch.Generator().manual_seed(0)

    def step() -> None:
        outcome = task.advance(2 * torch.rand(task.num_envs, NUM_ACTIONS, generator=generator) - 1)
        task.reset(outcome.done)
        task.sense()
        task.observe()

    return step


def _parts(task: TerrainNav) -> dict[str, Callable[[], Any]]:
    """Return the parts of a step with the map in the loop as calls, and a height scan of 187 points."""
    sight, pose = task.sight, task.T_map_base
    assert isinstance(sight, MapSight)
    clouds = sight.look(pose, task.tile_ids)
    scan = HeightScan.isaac_lab()
    return {
        "cast 512 rays": lambda: [camera(task.course.field, task.tile_ids, pose) for camera in sight.cameras],
        "cast rays, with the sensors' errors": lambda: sight.look(pose, task.tile_ids),
        "update the map": lambda: sight.emap.update(*clouds, sight.T_estimated, task.cfg.dt),
        "height scan of 187 points": lambda: scan(sight.emap, pose),
        "crop of 16 x 16 x 4": lambda: sight.image(pose, task.tile_ids),
        "critic's crop of the truth": lambda: task.truth.image(pose, task.tile_ids),
    }


@torch.inference_mode()
def measure(seconds: float) -> dict[str, Any]:
    """Time whole steps and their parts."""
    tasks = {mode: TerrainNav(None, NUM_ENVS, perception=mode, compiled=True) for mode in ("map", "truth", "blind")}
    steps = {f"step, {mode}": _step(task) for mode, task in tasks.items()}
    for _ in range(20):
        for step in steps.values():
            step()
    still = TerrainNav(None, NUM_ENVS, perception="map", compiled=True)  # its robots do not move, unlike the others'
    for _ in range(10):
        still.sense()
    return interleaved(steps | _parts(still), seconds)


def table(times: dict[str, Any]) -> str:
    """Tabulate the times [ms]."""
    rows = [[name, f"{row['median']:.1f}", f"{row['min']:.1f}"] for name, row in times.items()]
    return markdown_table([f"{NUM_ENVS} robots", "median ms", "min ms"], rows)


def _driven_maps(robots: int) -> tuple[ElevationMap, Tensor]:
    """Return maps of robots that drove, up to 64 different ones, and poses of any heading."""
    drive = Drive(full_config(64), MANY_POINTS, min(robots, 64), compiled=False)
    drive.watch(6)
    emap = ElevationMap(drive.emap.cfg, robots)
    which = torch.arange(robots) % drive.emap.num_envs
    emap.load_state(map_layers(lambda value: value[which], drive.emap.state))
    T = drive.poses[5][:1].repeat(robots, 1, 1)
    angle = 2 * math.pi * torch.rand(robots, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    T[:, 0, 0] = T[:, 1, 1] = angle.cos()
    T[:, 1, 0], T[:, 0, 1] = angle.sin(), -angle.sin()
    return emap, T


def _cells_below(scan: HeightScan, emap: ElevationMap, T: Tensor) -> Tensor:
    """Return the flat numbers (B, P) of the cells that hold the points."""
    i, j = (torch.floor(scan.xy(T) / emap.cfg.grid.resolution) - emap.corner[:, None]).long().unbind(-1)
    return i * emap.cfg.grid.width + j


@torch.inference_mode()
def measure_scans(robots: int, seconds: float) -> dict[str, Any]:
    """Time height scans by preset and fill, and a bare gather of as many cells."""
    emap, T = _driven_maps(robots)
    cells = _cells_below(HeightScan.isaac_lab(), emap, T)
    runs: dict[str, Callable[[], Any]] = {"gather": lambda: emap.elevation.flatten(1).gather(1, cells)}
    for preset, fill in itertools.product(PRESETS, (*FILLS, ORIGINAL)):
        runs[f"{preset}, {fill}"] = partial(HeightScan.preset(preset, fill=fill), emap, T)
    return interleaved(runs, seconds)


def scan_table(times: dict[str, Any], robots: int) -> str:
    """Tabulate the times [ms], and their ratio to that of the gather."""
    gather = times["gather"]["median"]
    rows = [[name, f"{row['median']:.3g}", f"{row['median'] / gather:.1f}"] for name, row in times.items()]
    return markdown_table([f"{robots} x 187 points", "median ms", "gathers"], rows)


@click.command(help=__doc__)
@click.option("--seconds", default=5.0, show_default=True, help="Time per row [s].")
@click.option("--scans", type=int, help="Robots whose height scans to time; nothing else is.")
def main(seconds: float, scans: int | None) -> None:
    """Measure, write JSON and print the table."""
    if scans is not None:
        click.echo(scan_table(measure_scans(scans, seconds), scans))
        return
    times = measure(seconds)
    write_json(RESULTS / "sight.json", {"num_envs": NUM_ENVS, "rows": times})
    click.echo(table(times))


if __name__ == "__main__":
    main()
