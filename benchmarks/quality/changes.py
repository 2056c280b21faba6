"""How soon a new obstacle shows, and whether one that left does: `python -m benchmarks.quality.changes`

Robots stand still on rough ground, each with its own ground and noise, all in one batch. Obstacles: after 60 s of
empty ground a box of 0.3 m, a person or a wall stands 2.5 m ahead; counted are the scans until half of the cells in
which it stands and points hit it show it, 0.15 m above the ground or higher. Plates: the same for one of 3 cm and the
cells whose centres it covers, until it shows to 80 %, for several rates of aging. Ghosts: a person crosses the view
four times; counted are the cells that stay more than 0.1 m above the ground 3 s after, and which of them a ray of the
last scan passes below, so that the map could know. Writes benchmarks/results/changes.json.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import click
import torch
from torch import Tensor
from tqdm import tqdm

from torchelev import AgingConfig, ElevationMap, ElevationMapConfig, GridConfig
from torchelev.app.results import commit, markdown_table, write_json
from torchelev.grid import locate
from torchelev.sim import Boxes, DepthCamera, HeightField, Lidar, MountedSensor, mount
from torchelev.sim.exact import noise
from torchelev.sim.waves import natural_waves
from torchelev.stages.cells import PointCells

RESULTS = Path(__file__).parents[1] / "results"
GRID = GridConfig(resolution=0.04, length_x=8.0, length_y=8.0)
HALF_CELL = GRID.resolution / 2
BASE, MAST = 0.6, 0.3  # [m] the base above the ground, the sensor above the base
CAMERA = DepthCamera(width=64, height=48, max_range=6.0)
SENSORS = {
    "camera 64 x 48": MountedSensor(CAMERA, mount(28.6, z=MAST)),
    "camera 120 x 90": MountedSensor(DepthCamera(width=120, height=90, max_range=6.0), mount(28.6, z=MAST)),
    "lidar 16": MountedSensor(Lidar(rings=16, azimuths=720, fov_low_deg=-30, fov_high_deg=5), mount(0.0, z=MAST)),
    "lidar 32": MountedSensor(Lidar(rings=32, azimuths=720), mount(0.0, z=MAST)),
}
OBSTACLES = {"box": (0.15, 0.15, 0.15), "person": (0.15, 0.25, 0.85), "wall": (0.1, 1.0, 0.5)}  # [m] half sizes
PERSON = OBSTACLES["person"]
AHEAD = 2.5  # [m]
SETTLED = 600  # scans of empty ground, at 10 Hz
WATCHED = 40  # scans of the obstacle
SHARES = {"box": (1.0,), "person": (0.15, 0.03), "wall": (0.12, 0.03)}  # of the points: some 2, or 0.5, a cell
PLATE = (0.15, 0.15, 0.015)  # [m] half sizes
RATES = (1e-7, 1e-5, 1e-4, 1e-3)  # [m^2/s] of aging, the first is the default
HERTZ = (5, 10, 50)
SECTIONS = ("obstacles", "plates", "ghosts")
CROSSINGS, SECONDS, AFTER = 4, 5.0, 3.0  # how often, how long each [s], and when the ghosts are counted [s]
CLEARLY = 0.05  # [m]


class World:
    """B robots that stand still, each on ground of its own, and what their sensors and maps see of it."""

    def __init__(self, sensor: MountedSensor, seeds: int, compiled: bool, amplitude: float = 0.03, **cfg: Any) -> None:
        places = torch.linspace(-6.0, 6.0, 301, dtype=torch.float64)
        x, y = torch.meshgrid(places, places, indexing="ij")
        ground = torch.stack([natural_waves(seed, amplitude)(x, y) for seed in range(seeds)]).float()
        self.sensor, self.seeds = sensor, seeds
        self.field, self.tiles = HeightField(ground, resolution=0.04), torch.arange(seeds)
        self.T_map_base = torch.eye(4, dtype=torch.float64).repeat(seeds, 1, 1)
        self.T_map_base[:, 2, 3] = ground[:, 150, 150] + BASE
        self.T_map_sensor = sensor.T_map_sensor(self.T_map_base)
        self.generator = torch.Generator().manual_seed(0)
        self.emap = ElevationMap(ElevationMapConfig(grid=GRID, **cfg), seeds)
        if compiled:
            self.emap.compile()

    def scan(self, boxes: Boxes | None, dt: float, share: float = 1.0) -> Tensor:
        """Fuse one scan and return its points (B, N, 3), map frame."""
        points = self.sensor(self.field, self.tiles, self.T_map_base, boxes)
        points = noise.dropout(noise.noisy(points, self.generator), self.generator, share=1 - share)
        self.emap.update(points, self.T_map_sensor, self.T_map_base, dt=dt)
        T = self.T_map_sensor.float()
        return points @ T[:, :3, :3].mT + T[:, None, :3, 3]

    def above_ground(self) -> Tensor:
        """Return how far each cell's elevation lies above the ground (B, H, W) [m], NaN where it is unknown."""
        centers = self.emap.cell_centers().flatten(1, 2)
        truth = self.field.height(self.tiles, centers).view_as(self.emap.elevation)
        return torch.where(self.emap.validity, self.emap.elevation - truth, math.nan)

    def ahead(self, half: tuple[float, float, float]) -> Boxes:
        """Return an obstacle ahead of each sensor, somewhere within a cell."""
        x, y = (torch.rand(2, self.seeds, generator=self.generator) - 0.5) * GRID.resolution
        return self.box(AHEAD + half[0] + x, y, half)

    def box(self, x: Tensor, y: Tensor, half: tuple[float, float, float]) -> Boxes:
        """Return an upright box in each environment, standing at (x, y) (B,) [m]."""
        T = torch.eye(4).repeat(self.seeds, 1, 1, 1)
        T[:, 0, 0, 3], T[:, 0, 1, 3], T[:, 0, 2, 3] = x, y, half[2]
        return Boxes(T, torch.tensor(half).expand(self.seeds, 1, 3))


def obstacle_scans(
    sensor: MountedSensor, obstacle: str, share: float, seeds: int, settled: int, compiled: bool
) -> dict[str, Any]:
    """Return how many scans pass until half of the cells hit show the obstacle, and how many points hit most a scan."""
    world = World(sensor, seeds, compiled)
    for _ in range(settled):
        world.scan(None, 0.1, share)
    boxes = world.ahead(OBSTACLES[obstacle])
    points, shown = torch.zeros_like(world.emap.elevation), []
    for _ in range(WATCHED):
        points += hits(world, world.scan(boxes, 0.1, share), boxes)
        hit = points > 0
        shows = hit & (world.above_ground() > 0.15)
        shown.append(2 * shows.sum((1, 2)) >= hit.sum((1, 2)).clamp(min=1))
    return scans_until(shown) | {"points": float(points[points > 0].median()) / WATCHED}


def scans_until(shown: list[Tensor]) -> dict[str, int]:
    """Return after how many scans (B,) first was true: the median and the most; one more than all if it never was."""
    ever = torch.stack([*shown, torch.ones_like(shown[0])])
    scans = (ever.int().argmax(0) + 1).sort().values
    return {"median": int(scans[len(scans) // 2]), "most": int(scans[-1])}


def hits(world: World, points: Tensor, boxes: Boxes, above: float = 0.05, beside: float = HALF_CELL) -> Tensor:
    """Count the points (B, H, W) so far above the ground [m] in each cell in which part of the obstacle stands.

    `beside`: how far from the obstacle the cell's centre may lie [m]; with 0 it covers the centre.
    """
    xy, z = points[..., :2].nan_to_num(), points[..., 2]
    on = z > world.field.height(world.tiles, xy) + above
    slot, inside = locate(*xy.unbind(-1), -world.emap.state.corner * GRID.resolution, GRID)
    (number,) = PointCells(slot.long(), inside, GRID.num_cells).sums((on & inside).float())
    place, half = boxes.T_map_box[:, 0, :2, 3], boxes.half_size[:, 0, :2] + beside
    stands = ((world.emap.cell_centers() - place[:, None, None]).abs() < half[:, None, None]).all(-1)
    return number.view_as(world.emap.elevation) * stands


def plate_scans(sensor: MountedSensor, rate: float, seeds: int, settled: int, compiled: bool) -> dict[str, Any]:
    """Return how far long standing ground is off where a plate comes to lie, and after how many scans it shows to 80 %.

    On flat ground, so that all of the plate lies above it.
    """
    world = World(sensor, seeds, compiled, amplitude=0.0, aging=AgingConfig(variance_rate=rate))
    for _ in range(settled):
        world.scan(None, 0.1)
    boxes, flat = world.ahead(PLATE), world.above_ground()
    hit, shown = torch.zeros_like(world.emap.validity), []
    for _ in range(WATCHED):
        hit |= hits(world, world.scan(boxes, 0.1), boxes, above=0.0, beside=0.0) > 0
        shown.append(torch.where(hit, world.above_ground(), math.nan).nanmean((1, 2)) >= 0.8 * 2 * PLATE[2])
    return scans_until(shown) | {"rmse_mm": 1e3 * float(flat[hit].square().nanmean().sqrt())}


def crossing(world: World, dt: float) -> Iterator[Boxes]:
    """Yield a person who crosses in front of each sensor, each time at another distance, speed and angle."""
    for _ in range(CROSSINGS):
        near, slant = (torch.rand(2, world.seeds, generator=world.generator) * torch.tensor([[1.8], [1.0]])).unbind(0)
        speed = 1.3 + 0.4 * torch.rand(world.seeds, generator=world.generator)
        side = torch.sign(torch.rand(world.seeds, generator=world.generator) - 0.5)
        for k in range(round(SECONDS / dt)):
            along = speed * (k * dt - SECONDS / 2)
            yield world.box(1.2 + near + (slant - 0.5) * along, side * along, PERSON)


def ghosts(sensor: MountedSensor, hertz: int, seeds: int, compiled: bool) -> dict[str, Any]:
    """Return how many cells stay above the ground after crossings: in all environments, and in how many of them."""
    world, dt = World(sensor, seeds, compiled), 1 / hertz
    for boxes in crossing(world, dt):
        world.scan(boxes, dt)
    gone = world.box(torch.zeros(seeds), torch.zeros(seeds), (0.0, 0.0, 0.0))
    points = torch.full((seeds, 1, 3), math.nan)
    for _ in range(round(AFTER * hertz)):
        points = world.scan(gone, dt)
    left = world.above_ground() > 0.1
    number, seen = left.sum((1, 2)), seen_through(world, left, points)
    return {
        "cells": int(number.sum()),
        "environments": int((number > 0).sum()),
        "seen_through": int(seen.sum()),
        "environments_seen_through": int((seen > 0).sum()),
        "of": seeds,
    }


def seen_through(world: World, cells: Tensor, points: Tensor) -> Tensor:
    """Count the cells (B, H, W) that a ray to the points (B, N, 3) passes CLEARLY below: -> (B,)."""
    numbers = []
    centers, heights = world.emap.cell_centers(), world.emap.elevation
    for marked, center, height, ends, T in zip(
        cells, centers, heights, points, world.T_map_sensor.float(), strict=True
    ):
        ray, place = ends - T[:3, 3], center[marked][:, None] - T[:2, 3]
        reach = ray[:, :2].norm(dim=-1)
        forward = ray[:, :2] / reach[:, None]
        along = (place * forward).sum(-1)
        beside = (place[..., 0] * forward[:, 1] - place[..., 1] * forward[:, 0]).abs() < HALF_CELL
        over = beside & (along > 0) & (along < reach - 2 * GRID.resolution)
        below = T[2, 3] + along * ray[:, 2] / reach < height[marked][:, None] - CLEARLY
        numbers.append((over & below).any(1).sum())
    return torch.stack(numbers)


def tables(result: dict[str, Any]) -> str:
    """Tabulate all three."""

    def scans(row: dict[str, Any]) -> list[str]:
        return [str(row[k]) if row[k] <= WATCHED else f"> {WATCHED}" for k in ("median", "most")]

    new = [[name, f"{row['points']:.1f}", *scans(row)] for name, row in result["obstacles"].items()]
    plates = [[name, f"{row['rmse_mm']:.2f}", *scans(row)] for name, row in result["plates"].items()]
    columns = ("seen_through", "environments_seen_through", "cells", "environments", "of")
    left = [[name, *(str(row[column]) for column in columns)] for name, row in result["ghosts"].items()]
    return "\n\n".join(
        [
            markdown_table(["obstacle", "points a cell", "scans to half, median", "most"], new),
            markdown_table(["aging [m²/s]", "error before [mm]", "scans to 80 %, median", "most"], plates),
            markdown_table(
                ["sensor", "cells left, seen through", "robots with such", "cells left", "robots with any", "robots"],
                left,
            ),
        ]
    )


def rows(
    seeds: int, settled: int, hertz: tuple[int, ...], compiled: bool
) -> Iterator[tuple[str, str, Callable[[], dict[str, Any]]]]:
    """Yield the section, the name and the measurement of every row."""
    camera, how = SENSORS["camera 120 x 90"], (seeds, settled, compiled)
    for name, shares in SHARES.items():
        for share in shares:
            yield "obstacles", f"{name}, {share:.1%} of the points", partial(obstacle_scans, camera, name, share, *how)
    for rate in RATES:
        yield "plates", f"{rate:.0e}", partial(plate_scans, camera, rate, *how)
    for name, sensor in SENSORS.items():
        for rate in hertz:
            yield "ghosts", f"{name} at {rate} Hz", partial(ghosts, sensor, rate, seeds, compiled)


@click.command()
@click.option("--seeds", default=50, show_default=True, help="Environments: grounds, people and noises.")
@click.option("--settled", default=SETTLED, show_default=True, help="Scans of empty ground before an obstacle.")
@click.option("--only", type=click.Choice(SECTIONS), help="Measure one of the three.")
@click.option("--hertz", type=int, multiple=True, default=HERTZ, show_default=True, help="Rates of the ghosts' scans.")
@click.option("--compiled/--eager", default=True, show_default=True, help="Compile the map's updates.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Where to write.")
def main(seeds: int, settled: int, only: str | None, hertz: tuple[int, ...], compiled: bool, out: Path) -> None:
    """Count scans until new obstacles and plates show, and what stays of people who left.

    Each row is written at once; rows that are not measured stay as they were.
    """
    torch.set_num_threads(2)
    path = out / "changes.json"
    result = json.loads(path.read_text()) if path.exists() else {}
    result = {name: result.get(name, {}) for name in SECTIONS}
    for section, name, measure in tqdm(
        [row for row in rows(seeds, settled, hertz, compiled) if only in (None, row[0])]
    ):
        result[section][name] = measure() | {"seeds": seeds, "settled": settled, "commit": commit()}
        write_json(path, result)
    click.echo(tables(result))


if __name__ == "__main__":
    main()
