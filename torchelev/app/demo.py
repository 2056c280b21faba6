"""A newcomer's first map: a simulated robot walks a course with a depth camera, and its map is drawn beside the truth.

Run ``make demo`` or ``python -m torchelev demo``; ``--help`` lists what can be changed. Needs ``torchelev[io]``.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap
from torchelev.grid import GridConfig
from torchelev.output_files import MARK, atomic_file, require_writable
from torchelev.sim import Box, DepthCamera, Scene, Trajectory, mount, outliers, range_noise, walk
from torchelev.sim.exact.scenes import block, steps
from torchelev.sim.waves import natural_waves

if TYPE_CHECKING:
    from torchelev.viz.plot import Panel

ROUTE = ((-3.4, -1.6), (2.9, -1.6), (2.9, 1.5), (-2.6, 1.5), (-2.6, -0.2), (0.2, -0.2))  # [m]
SPEED, DT = 0.8, 0.2  # [m/s], [s]
PERSON_LEAVES = 6.0  # [s]
# Pitched less than a camera for footholds would be, so that it sees the bar ahead of the robot.
CAMERA, T_BASE_CAMERA = DepthCamera(max_range=6.0), mount(pitch_deg=20.0)
GRID = GridConfig(resolution=0.04, length_x=12.0, length_y=9.6)
LANDMARKS = (
    ("stairs", -1.6, -2.9), ("platform", -0.4, -0.95), ("ramp", 1.3, -2.6), ("wall", 0.2, 0.85), ("box", 2.15, 0.25),
    ("wall", 1.9, 2.9), ("bar overhead", 0.6, 1.95), ("rough ground", -3.2, 2.4), ("person, leaves", 4.4, 0.85),
)  # fmt: skip
WARM_UP = 3  # updates that do not count as time per update


@dataclass(frozen=True, kw_only=True)
class DemoResult:
    """What the demo measured, over the cells that the map knows at the end."""

    rmse: float  #: [m]
    rmse_off_steps: float  #: [m] over the cells that no step cuts, nor their neighbours
    p95: float  #: [m] 95 % of the cells are this near the truth or nearer
    coverage: float  #: share of the cells hit by any ray that the map knows
    ms_per_update: float  #: [ms] median
    updates: int  #: number of scans that were fused

    def __str__(self) -> str:
        return (
            f"RMSE {100 * self.rmse:.2f} cm ({100 * self.rmse_off_steps:.2f} cm away from steps), "
            f"p95 {100 * self.p95:.2f} cm, coverage {100 * self.coverage:.1f} % of the cells seen, "
            f"{self.ms_per_update:.1f} ms per update"
        )


class DemoScan(NamedTuple):
    """One instant of the recording."""

    points: Tensor  #: (N, 3) [m] sensor frame
    T_map_sensor: Tensor  #: (4, 4)
    T_map_base: Tensor  #: (4, 4)


def course() -> Scene:
    """Make the course: stairs up and a ramp down, a person, a bar over the way, walls, rough ground."""
    relief = natural_waves(7, amplitude=0.06)
    gradient, top = math.tan(math.radians(15.0)), 0.6

    def terrain(x: Tensor, y: Tensor) -> Tensor:
        # The ramp falls along +x from the platform, with embankments at its sides.
        sides = 0.5 * torch.minimum(-0.413 - y, y + 3.813)
        ramp = torch.minimum(torch.minimum(gradient * (2.4 - x), 0.5 * (x + 1.3)), sides).clamp(0.0, top)
        return ramp + relief(x, y) * torch.minimum(-(x + 0.4), y - 0.3).clamp(0.0, 1.0)

    climb = steps(-2.013, -2.613, -0.613, count=4, rise=0.15, run=0.29)
    platform = block(-2.013 + 4 * 0.29, 0.113, -2.613, -0.613, top)
    walls = (block(1.187, 1.511, 2.313, 3.387, 0.6), block(-1.213, 1.187, 0.413, 0.647, 0.45))
    bar = Box(low=(0.507, 0.7, 1.42), high=(0.661, 2.3, 1.56))
    return Scene(
        name="course",
        terrain=terrain,
        steepness=max(0.5, relief.steepness + 0.1),  # ramp and relief lie apart; fading adds the relief's height
        boxes=(*climb, platform, *walls, block(1.713, 2.087, 0.413, 0.787, 0.25), bar, *_person()),
    )


def _person() -> tuple[Box, Box]:
    """Make a person who stands beside the way until `PERSON_LEAVES`, then walks off to the left."""
    x, y, pace = 3.513, 0.6, 1.0
    low, high = (x, y, 0.0), (x + 0.4, y + 0.5, 1.7)
    behind = pace * PERSON_LEAVES  # where the walk would have started at t = 0
    return (
        Box(low=low, high=high, until=PERSON_LEAVES),
        Box(
            low=(x, y - behind, 0.0), high=(x + 0.4, y + 0.5 - behind, 1.7), velocity=(0.0, pace, 0.0),
            since=PERSON_LEAVES,
        ),
    )  # fmt: skip


def observe(scene: Scene, path: Trajectory, k: int, generator: torch.Generator) -> DemoScan:
    """Return what the camera sees at step k: range noise, and 1 % of the pixels at wrong depths."""
    points = CAMERA.cast(scene, path.T_map_sensor[k], float(path.times[k]))
    points = outliers(range_noise(points, generator), generator, dust=0.005, flying=0.005)
    return DemoScan(points, path.T_map_sensor[k], path.T_map_base[k])


def fuse(emap: ElevationMap, frame: DemoScan) -> float:
    """Fuse one frame and return how long it took [ms]."""
    start = time.perf_counter()
    emap.update(frame.points[None], frame.T_map_sensor[None], frame.T_map_base[None], DT)
    return 1e3 * (time.perf_counter() - start)


class Seen:
    """Marks the cells that a return touched since they entered the window: what the map could know."""

    def __init__(self, resolution: float, reach: float = 12.0) -> None:
        self.resolution = resolution
        self.half = round(reach / resolution)
        self.cells = torch.zeros(2 * self.half, 2 * self.half, dtype=torch.bool)

    def add(self, frame: DemoScan, window: Tensor) -> None:
        """Mark the cells of one frame's returns; forget the cells outside the window, centres (H, W, 2)."""
        T = frame.T_map_sensor
        points = frame.points[frame.points.isfinite().all(-1)].double()
        self.cells[self._index((points @ T[:3, :3].T + T[:3, 3])[:, :2])] = True
        left = self.cells.clone()
        left[self._index(window)] = False
        self.cells &= ~left

    def mask(self, xy: Tensor) -> Tensor:
        """Tell which cells, by their centres (H, W, 2), were marked."""
        return self.cells[self._index(xy)]

    def _index(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        cell = (torch.floor(xy / self.resolution).long() + self.half).clamp(0, 2 * self.half - 1)
        return cell[..., 0], cell[..., 1]


def run_demo(out: str | Path = "demo.png", seconds: float | None = None, progress: bool = True) -> DemoResult:
    """Walk the course, map it, draw it.

    Args:
        out: the picture to write.
        seconds: of simulated time to walk; None: the whole course (about 30 s).
        progress: show a progress bar.

    Raises WriteError, before the walk, if the picture cannot be written.
    """
    require_writable(out)
    torch.manual_seed(0)
    scene, generator = course(), torch.Generator().manual_seed(0)
    path = walk(scene, ROUTE, speed=SPEED, dt=DT, T_base_sensor=T_BASE_CAMERA)
    count = len(path.times) if seconds is None else min(len(path.times), max(1, round(seconds / DT)))
    emap = ElevationMap(ElevationMapConfig(grid=GRID), num_envs=1)
    seen, took = Seen(GRID.resolution), []
    for k in tqdm(range(count), desc="walking and mapping", unit="scan", disable=not progress):
        frame = observe(scene, path, k, generator)
        took.append(fuse(emap, frame))
        seen.add(frame, emap.cell_centers()[0])
    result = assess(emap, scene, seen, took, float(path.times[count - 1]))
    draw(out, emap, scene, path.T_map_base[:count, :2, 3], float(path.times[count - 1]), result)
    return result


def assess(emap: ElevationMap, scene: Scene, seen: Seen, took: list[float], t: float) -> DemoResult:
    """Compare the map with the truth at time t [s]."""
    xy, elevation = emap.cell_centers()[0], emap.layer("elevation")[0].double()
    error = (elevation - scene.truth(xy, t)).abs()
    known, touched = error.isfinite(), seen.mask(xy)
    off_steps = error[known & ~at_step(scene, xy, t)]
    return DemoResult(
        rmse=float(error[known].square().mean().sqrt()),
        rmse_off_steps=float(off_steps.square().mean().sqrt()),
        p95=float(error[known].quantile(0.95)),
        coverage=float((known & touched).sum() / touched.sum()),
        ms_per_update=float(torch.tensor(took[WARM_UP:] or took).median()),
        updates=len(took),
    )


def at_step(scene: Scene, xy: Tensor, t: float) -> Tensor:
    """Tell which cells (H, W), by their centres (H, W, 2), a step of 5 cm or more cuts, or passes within a cell of."""
    reach = GRID.resolution * torch.tensor([-1.5, -0.5, 0.5, 1.5], dtype=torch.float64)
    around = torch.cartesian_prod(reach, reach)
    z = scene.truth(xy[..., None, :] + around, t)
    return z.amax(-1) - z.amin(-1) > 0.05


def draw(out: str | Path, emap: ElevationMap, scene: Scene, walked: Tensor, t: float, result: DemoResult) -> None:
    """Write the picture: truth, elevation, error, variance, traversability and upper bound side by side."""
    from torchelev.viz.plot import draw_layers

    xy = emap.cell_centers()[0]
    low, high = xy[0, 0] - GRID.resolution / 2, xy[-1, -1] + GRID.resolution / 2
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    panels = make_panels(emap, scene.truth(xy, t))
    title = f"A simulated walk: {result.updates} scans in one map\n{result}"
    figure = draw_layers(panels, extent=extent, path_xy=walked.numpy(), title=title)
    for name, x, y in LANDMARKS:
        box = {"boxstyle": "round,pad=0.15", "facecolor": "black", "alpha": 0.55, "linewidth": 0}
        figure.axes[0].text(x, y, name, color="white", fontsize=7, ha="center", va="center", bbox=box)
    kind = Path(out).suffix.removeprefix(".") or "png"
    metadata = {"Software": MARK} if kind == "png" else None
    with atomic_file(out) as file:
        figure.savefig(file, format=kind, metadata=metadata, dpi=110, bbox_inches="tight", pad_inches=0.1)


def make_panels(emap: ElevationMap, truth: Tensor) -> list[Panel]:
    """Choose what the picture shows, heights on one colour scale."""
    from torchelev.viz.plot import Panel

    layers = {name: emap.layer(name)[0].double() for name in ("elevation", "variance", "traversability", "upper_bound")}
    deviation = 1e3 * layers["variance"].sqrt()
    error = 100 * (layers["elevation"] - truth)
    low, high = float(truth.min()), float(truth.max())

    def heights(title: str, values: Tensor) -> Panel:
        return Panel(title=title, values=values.numpy(), unit="m", vmin=low, vmax=high)

    def others(title: str, values: Tensor, unit: str, cmap: str, vmin: float, vmax: float) -> Panel:
        return Panel(title=title, values=values.numpy(), unit=unit, cmap=cmap, vmin=vmin, vmax=vmax)

    return [
        heights("truth, and the robot's path", truth),
        heights("elevation (grey: not known)", layers["elevation"]),
        others("error: elevation less truth", error, "cm", "RdBu_r", -5.0, 5.0),
        others("square root of the variance", deviation, "mm", "magma", 0.0, 50.0),
        others("traversability", layers["traversability"], "1: flat, 0: impassable", "RdYlGn", 0.0, 1.0),
        heights("upper bound: where not seen, at most this", layers["upper_bound"]),
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demo from the command line."""
    parser = argparse.ArgumentParser(prog="python -m torchelev demo", description="Map a simulated walk and draw it.")
    parser.add_argument("--out", default="demo.png", help="picture to write (default: %(default)s)")
    parser.add_argument("--seconds", type=float, help="simulated time to walk (default: the whole course)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    args = parser.parse_args(argv)
    result = run_demo(args.out, args.seconds, not args.quiet)
    print(f"{result.updates} scans mapped: {result}")
    print(f"Wrote {args.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
