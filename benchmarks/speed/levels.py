"""Time updates of maps with levels beside those without, and voxel crops.

    python -m benchmarks.speed.levels

All stages are on. Robots drive over rough ground as in `common.workload`, or walk below a table, where a cell
holds several surfaces. Three levels may take 1.6 times the time of one and 2.5 times the memory, and a voxel crop of
32 x 32 x 40 for 256 robots 5 ms, or 60 ms of distances, on two threads. Writes benchmarks/results/levels_speed.json.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import click
import torch

from benchmarks import RESULTS
from benchmarks.speed.common.meter import interleaved
from benchmarks.speed.common.workload import BPEARL, MANY_POINTS, Drive, full_config
from torchelev import ElevationMap, LevelsConfig
from torchelev.app.results import machine, markdown_table, write_json
from torchelev.observations import VoxelCrop
from torchelev.sim import Lidar, walk
from torchelev.sim.exact.covered_scenes import table as table_scene

DRIVES = {
    "rough ground, one robot, 43,074 points": (1, BPEARL, 250),
    "rough ground, 256 robots": (256, MANY_POINTS, 64),
}
LEVELS = (1, 2, 3)


class TableWalk:
    """A robot that walks below a table and back; each call fuses the next of 43,072 points."""

    def __init__(self, levels: LevelsConfig | None) -> None:
        scene, lidar = (
            table_scene(),
            Lidar(rings=64, azimuths=673, fov_low_deg=-60.0, fov_high_deg=60.0, max_range=12.0),
        )
        path = walk(scene, [(-1.0, 0.0), (3.0, 0.2), (-1.0, 0.0)], height=0.4, dt=0.5)
        clouds = [lidar.cast(scene, T)[None] for T in path.T_map_sensor]
        self.emap = ElevationMap(replace(full_config(200), levels=levels))
        self.scans = itertools.cycle(zip(clouds, path.T_map_sensor[:, None], path.T_map_base[:, None], strict=True))

    def __call__(self) -> None:
        """Fuse the next scan."""
        self.emap.update(*next(self.scans), dt=0.1)


def make_runs() -> dict[str, dict[int, Any]]:
    """Return what is timed: by scenario, and by number of levels."""

    def levels(number: int) -> LevelsConfig | None:
        return LevelsConfig(max_levels=number) if number > 1 else None

    runs: dict[str, dict[int, Any]] = {
        name: {k: Drive(replace(full_config(cells), levels=levels(k)), points, robots) for k in LEVELS}
        for name, (robots, points, cells) in DRIVES.items()
    }
    return runs | {"below a table, one robot, 43,072 points": {k: TableWalk(levels(k)) for k in LEVELS}}


def time_updates(seconds: float) -> list[dict[str, Any]]:
    """Time updates with each number of levels, interleaved, and their memory."""
    rows = []
    for name, runs in make_runs().items():
        for run, _ in itertools.product(runs.values(), range(40)):
            run()
        times = interleaved(runs, seconds, rounds=8)
        sizes = {k: sum(buffer.nbytes for buffer in run.emap.buffers()) for k, run in runs.items()}
        for k, row in times.items():
            ratios = {"ratio": row["median"] / times[1]["median"], "memory_ratio": sizes[k] / sizes[1]}
            rows.append({"maps": name, "levels": k, **row, **ratios})
    return rows


def time_crops(seconds: float) -> dict[str, dict[str, float]]:
    """Time voxel crops of 32 x 32 x 40 for 256 robots."""
    drive = Drive(replace(full_config(64), levels=LevelsConfig()), MANY_POINTS, 256)
    for _ in range(20):
        drive()
    _, T = drive.next_scan()
    crop, distances = VoxelCrop(), VoxelCrop(values="distances")
    runs: dict[str, Callable[[], Any]] = {"states": lambda: crop(drive.emap, T)}
    runs |= {"distances": lambda: distances(drive.emap, T)}
    return interleaved(runs, seconds, rounds=5)


def table(result: dict[str, Any]) -> str:
    """Tabulate times [ms] beside those of one level, and memory."""
    rows = [
        [row["maps"], str(row["levels"]), f"{row['median']:.2f}", f"{row['ratio']:.2f}", f"{row['memory_ratio']:.2f}"]
        for row in result["updates"]
    ]
    updates = markdown_table(["maps", "levels", "median ms", "times one level", "times its memory"], rows)
    crops = [[name, f"{row['median']:.2f}", f"{row['min']:.2f}"] for name, row in result["crops"].items()]
    voxels = markdown_table(["32 x 32 x 40 voxels for 256 robots", "median ms", "min ms"], crops)
    return f"{updates}\n\n{voxels}\n\n{result['threads']} threads."


@click.command(help=__doc__)
@click.option("--seconds", default=8.0, show_default=True, help="Time per row [s].")
def main(seconds: float) -> None:
    """Measure, write JSON and print the tables."""
    torch.set_num_threads(2)
    result = {"machine": machine(), "threads": 2, "updates": time_updates(seconds), "crops": time_crops(seconds)}
    write_json(RESULTS / "levels_speed.json", result)
    click.echo(table(result))


if __name__ == "__main__":
    main()
