"""Time the ray casting of simulated sensors, with and without boxes, and measure the memory of a terrain tile.

    python -m benchmarks.speed.sensors                   # benchmarks/results/sensors.json, one minute
    python -m benchmarks.speed.sensors --device cuda     # benchmarks/results/sensors-NAME.json

The robots stand at random places on all kinds of terrain, easy to hard.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks import RESULTS
from benchmarks.speed.common import meter
from benchmarks.speed.common.workload import by_tensors
from torchelev.app.results import markdown_table, slug, write_json
from torchelev.sim import DepthCamera, Lidar, mount
from torchelev.sim.exact.sensors import NonRepetitiveLidar
from torchelev.sim.poses import pose
from torchelev.sim.sensors.casting import Boxes
from torchelev.sim.sensors.mounted import MountedSensor
from torchelev.sim.terrains.generate import terrain_grid
from torchelev.sim.terrains.heightfield import HeightField
from torchelev.sim.terrains.shapes import SHAPES

_LEVELS = 8
SENSORS = {
    "camera 32 x 16, 8 m": MountedSensor(DepthCamera(width=32, height=16), mount(35.0, 0.3, 0.1)),
    "lidar 16 x 32, 20 m": MountedSensor(Lidar(rings=16, azimuths=32), mount(0.0, 0.0, 0.25)),
    "rosette 512, 20 m": MountedSensor(NonRepetitiveLidar(rays=512), mount(20.0, 0.3, 0.1)),
}
CASES = [(name, robots, boxes) for name in SENSORS for robots, boxes in ((64, 0), (64, 12), (256, 0))]
HEIGHT = 0.55  # [m] of the base above the ground


def standing(field: HeightField, robots: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return tiles (B,) and poses (B, 4, 4) of robots within 3 m of their tile's center along each axis."""
    generator = torch.Generator().manual_seed(seed)
    tiles = torch.arange(robots) % field.num_tiles
    xy = 6.0 * torch.rand(robots, 2, generator=generator) - 3.0
    ground = field.to("cpu").height(tiles, xy[:, None])[:, 0]
    yaw = 2 * math.pi * torch.rand(robots, generator=generator, dtype=torch.float64)
    T_map_base = pose(torch.cat([xy, ground[:, None] + HEIGHT], -1).double(), yaw)
    return tiles.to(field.device), T_map_base.float().to(field.device)


def _legs(robots: int, count: int, device: str) -> Boxes | None:
    """Return boxes of a leg's size in a circle around the base, in the base frame."""
    if not count:
        return None
    angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    position = torch.stack([0.4 * angle.cos(), 0.4 * angle.sin(), torch.full_like(angle, -0.2)], -1)
    T_base_box = pose(position, angle, 0.3).float().to(device)
    half_size = torch.tensor([0.04, 0.04, 0.2], device=device)
    return Boxes(T_base_box.expand(robots, count, 4, 4), half_size.expand(robots, count, 3))


def measure(field: HeightField, seconds: float) -> list[dict[str, Any]]:
    """Time all cases in turn, on a CPU in C++ and by tensors."""
    casts: dict[tuple[str, int, int, str], Callable[[], Tensor]] = {}
    for name, robots, boxes in CASES:
        tiles, T = standing(field, robots)
        legs, step = _legs(robots, boxes, str(field.device)), torch.zeros_like(tiles)
        for code in ("C++", "tensors") if field.device.type == "cpu" else ("tensors",):
            measured = partial(SENSORS[name], field, tiles, T, legs=legs, step=step)
            casts[name, robots, boxes, code] = measured if code == "C++" else partial(_without_native, measured)
    times = meter.interleaved(casts, seconds)
    rows = []
    for case, cast in casts.items():
        rays, hits = cast().shape[:2].numel(), float(cast()[..., 0].isfinite().float().mean())
        row = dict(zip(("sensor", "robots", "boxes", "code"), case, strict=True)) | times[case]
        rows.append(row | {"rays": rays, "rays_per_second": 1e3 * rays / times[case]["median"], "hits": hits})
    return rows


def _without_native(cast: Callable[[], Tensor]) -> Tensor:
    with by_tensors():
        return cast()


def table(rows: list[dict[str, Any]]) -> str:
    """Tabulate the times [ms]."""
    head = ["sensor", "robots", "boxes", "by", "median ms", "min ms", "M rays/s", "hits"]
    lines = [
        [r["sensor"], str(r["robots"]), str(r["boxes"]), r["code"], f"{r['median']:.1f}", f"{r['min']:.1f}",
         f"{r['rays_per_second'] / 1e6:.1f}", f"{r['hits']:.0%}"]
        for r in rows
    ]  # fmt: skip
    return markdown_table(head, lines)


def main() -> None:
    """Measure, write JSON and print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed.sensors",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=6.0, help="time per case [s] (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="JSON file (default: in benchmarks/results)")
    options = parser.parse_args()
    grid = terrain_grid(list(SHAPES), _LEVELS, device=options.device)
    start = time.perf_counter()
    field = HeightField(grid.field.heights, grid.field.resolution)
    built = time.perf_counter() - start
    held = sum(value.nbytes for value in (field.padded, *field.bounds)) / field.num_tiles
    rows = measure(field, options.seconds)
    name = "" if options.device == "cpu" else "-" + slug(torch.cuda.get_device_name())
    tile = {"samples": list(field.heights.shape[1:]), "resolution": field.resolution, "bytes": held}
    result = {"tiles": field.num_tiles, "tile": tile, "seconds_to_build": built, "cases": rows}
    write_json(options.out or RESULTS / f"sensors{name}.json", result)
    print(table(rows))


if __name__ == "__main__":
    main()
