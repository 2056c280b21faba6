"""What sight costs while a policy learns: `python -m benchmarks.speed.sight`

Times a step of TerrainNav's 256 robots with two cameras of 256 rays each, part by part, and whole steps with the map
and with the true ground, into benchmarks/results/sight.json.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import torch

from benchmarks.speed.meter import interleaved
from envs.terrain_nav import TerrainNav
from envs.terrain_nav.task import NUM_ACTIONS
from torchelev import HeightScan
from torchelev.app.results import markdown_table, write_json

RESULTS = Path(__file__).parents[1] / "results"
NUM_ENVS = 256


def walking(task: TerrainNav) -> Callable[[], Any]:
    """Return a whole step: move at random, begin anew where an episode ended, look, observe."""
    generator = torch.Generator().manual_seed(0)

    def step() -> None:
        outcome = task.advance(2 * torch.rand(task.num_envs, NUM_ACTIONS, generator=generator) - 1)
        task.reset(outcome.done)
        task.sense()
        task.observe()

    return step


def parts(task: TerrainNav) -> dict[str, Callable[[], Any]]:
    """Return the parts of a step with the map in the loop, and a height scan of 187 points."""
    sight, pose = task.sight, task.T_map_base
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
    """Time parts and whole steps."""
    tasks = {mode: TerrainNav(None, NUM_ENVS, perception=mode, compiled=True) for mode in ("map", "truth", "blind")}
    steps = {f"step, {mode}": walking(task) for mode, task in tasks.items()}
    for _ in range(20):
        for step in steps.values():
            step()
    still = TerrainNav(None, NUM_ENVS, perception="map", compiled=True)  # the others move on meanwhile
    for _ in range(10):
        still.sense()
    return interleaved(steps | parts(still), seconds)


@click.command()
@click.option("--seconds", default=5.0, show_default=True, help="Time for each row.")
def main(seconds: float) -> None:
    """Time a step of TerrainNav by its parts."""
    times = measure(seconds)
    write_json(RESULTS / "sight.json", {"num_envs": NUM_ENVS, "rows": times})
    click.echo(table(times))


def table(times: dict[str, Any]) -> str:
    """Tabulate milliseconds."""
    rows = [[name, f"{row['median']:.1f}", f"{row['min']:.1f}"] for name, row in times.items()]
    return markdown_table([f"{NUM_ENVS} robots", "median ms", "min ms"], rows)


if __name__ == "__main__":
    main()
