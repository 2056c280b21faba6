"""Time what perception costs in the training of a policy.

    python -m benchmarks.speed.sight

Times the parts of a step of TerrainNav with 256 robots and two cameras of 256 rays each, and whole steps with the map,
with the true ground and blind. Writes benchmarks/results/sight.json.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click
import torch

from benchmarks import RESULTS
from benchmarks.speed.meter import interleaved
from envs.terrain_nav import TerrainNav
from envs.terrain_nav.sight import MapSight
from envs.terrain_nav.task import NUM_ACTIONS
from torchelev import HeightScan
from torchelev.app.results import markdown_table, write_json

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


@click.command(help=__doc__)
@click.option("--seconds", default=5.0, show_default=True, help="Time per row [s].")
def main(seconds: float) -> None:
    """Measure, write JSON and print the table."""
    times = measure(seconds)
    write_json(RESULTS / "sight.json", {"num_envs": NUM_ENVS, "rows": times})
    click.echo(table(times))


if __name__ == "__main__":
    main()
