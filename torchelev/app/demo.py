"""The demo: a simulated robot walks a course with a depth camera; its map is drawn beside the ground truth.

Run ``make demo`` or ``torchelev demo``. Needs ``torchelev[io]``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from torchelev.app.demo_course import LANDMARKS, ROUTE, make_course
from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.files.output_files import require_writable
from torchelev.grid import GridConfig
from torchelev.sim import DepthCamera, Scene, Trajectory, mount, outliers, range_noise, steps, walk

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from torchelev.viz.plot import Panel

SPEED, DT = 0.8, 0.2  # [m/s], [s]
# Pitched less than a camera for footholds would be, so that it sees the overhead bar in front of the robot.
CAMERA, T_BASE_CAMERA = DepthCamera(max_range=6.0), mount(pitch_deg=20.0)
GRID = GridConfig(resolution=0.04, length_x=12.0, length_y=9.6)
_WARM_UP = 3  # updates that the median time leaves out


@dataclass(frozen=True, kw_only=True)
class DemoResult:
    """Errors of the final map over its known cells, and the speed of updates."""

    rmse: float  #: [m]
    rmse_off_steps: float  #: [m] without cells at steps
    p95: float  #: [m] 95th percentile of the absolute error
    coverage: float  #: known fraction of the cells that were hit
    ms_per_update: float  #: [ms] median
    updates: int  #: number of scans fused

    @property
    def accuracy(self) -> str:
        """The errors as a line of text."""
        return (
            f"RMSE {100 * self.rmse:.2f} cm ({100 * self.rmse_off_steps:.2f} cm away from steps), "
            f"p95 {100 * self.p95:.2f} cm, coverage {100 * self.coverage:.1f} % of the cells seen"
        )

    def __str__(self) -> str:
        return f"{self.accuracy}, {self.ms_per_update:.1f} ms per update"


class DemoScan(NamedTuple):
    """One depth image with its poses."""

    points: Tensor  #: (N, 3) [m] sensor frame
    T_map_sensor: Tensor  #: (4, 4)
    T_map_base: Tensor  #: (4, 4)
    time: float  #: [s] since the start


class _HitCells:
    """Cells that were hit since they entered the window: those that the map can know."""

    def __init__(self, resolution: float, reach: float = 12.0) -> None:
        self.resolution = resolution
        self.half = round(reach / resolution)
        self.cells = torch.zeros(2 * self.half, 2 * self.half, dtype=torch.bool)

    def add(self, scan: DemoScan, window: Tensor) -> None:
        """Add the cells that a scan hit; drop those outside the window, given by its cell centres (H, W, 2) [m]."""
        T = scan.T_map_sensor
        points = scan.points[scan.points.isfinite().all(-1)].double()
        self.cells[self._index((points @ T[:3, :3].T + T[:3, 3])[:, :2])] = True
        outside = self.cells.clone()
        outside[self._index(window)] = False
        self.cells &= ~outside

    def at(self, xy: Tensor) -> Tensor:
        """Return which of the cells with centres (H, W, 2) [m] were hit, (H, W) bool."""
        return self.cells[self._index(xy)]

    def _index(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        cell = (torch.floor(xy / self.resolution).long() + self.half).clamp(0, 2 * self.half - 1)
        return cell[..., 0], cell[..., 1]


class DemoWalk:
    """The simulated walk. Iterating observes one scan after the other and fuses it into the map.

    Args:
        seconds: simulated time [s] to walk; None: the whole course, about 30 s.
        camera: what the robot sees with.

    Raises:
        ValueError: the time is not positive.
    """

    def __init__(self, seconds: float | None = None, camera: DepthCamera = CAMERA) -> None:
        if seconds is not None:
            require(0 < seconds < math.inf, "seconds", "must be positive", seconds, "leave it out for the whole course")
        self._camera = camera
        torch.manual_seed(0)
        self.scene = make_course()
        self.path = walk(self.scene, ROUTE, speed=SPEED, dt=DT, T_base_sensor=T_BASE_CAMERA)
        self._num_scans = len(self.path.times) if seconds is None else max(1, round(seconds / DT))
        self.emap = ElevationMap(ElevationMapConfig(grid=GRID), num_envs=1)
        self.update_ms: list[float] = []

    def __len__(self) -> int:
        return min(len(self.path.times), self._num_scans)

    def observe(self) -> Iterator[DemoScan]:
        """Yield the scans without fusing them."""
        generator = torch.Generator().manual_seed(0)
        for k in range(len(self)):
            yield _observe(self.scene, self.path, k, generator, self._camera)

    def __iter__(self) -> Iterator[DemoScan]:
        for scan in self.observe():
            self.update_ms.append(_fuse(self.emap, scan))
            yield scan


def run_demo(
    out: str | Path = "demo.png", seconds: float | None = None, progress: bool = True, camera: DepthCamera = CAMERA
) -> DemoResult:
    """Walk the course, map it and draw the result.

    Args:
        out: the picture to write.
        seconds: simulated time [s] to walk; None: the whole course, about 30 s.
        progress: show a progress bar.
        camera: what the robot sees with.

    Returns:
        The errors of the map and the speed of updates.

    Raises:
        WriteError: the picture cannot be written; raised before the walk, as is ValueError.
        ValueError: the suffix is not a picture's, or the time is not positive.
    """
    from torchelev.viz.style import require_picture

    require_picture(out)
    require_writable(out)
    demo, hit = DemoWalk(seconds, camera), _HitCells(GRID.resolution)
    for scan in tqdm(demo, desc="walking and mapping", unit="scan", disable=not progress):
        hit.add(scan, demo.emap.cell_centers()[0])
    end = float(demo.path.times[len(demo) - 1])
    result = _assess(demo.emap, demo.scene, hit, demo.update_ms, end)
    _draw(out, demo.emap, demo.scene, demo.path.T_map_base[: len(demo), :2, 3], end, result)
    return result


def _observe(scene: Scene, path: Trajectory, k: int, generator: torch.Generator, camera: DepthCamera) -> DemoScan:
    """Simulate the depth image of step k: range noise, and 1 % of the pixels at wrong depths."""
    points = camera.cast(scene, path.T_map_sensor[k], float(path.times[k]))
    points = outliers(range_noise(points, generator), generator, dust=0.005, flying=0.005)
    return DemoScan(points, path.T_map_sensor[k], path.T_map_base[k], float(path.times[k]))


def _fuse(emap: ElevationMap, scan: DemoScan) -> float:
    """Fuse one scan and return the time it took [ms]."""
    start = time.perf_counter()
    emap.update(scan.points[None], scan.T_map_sensor[None], scan.T_map_base[None], DT)
    return 1e3 * (time.perf_counter() - start)


def _assess(emap: ElevationMap, scene: Scene, hit: _HitCells, update_ms: list[float], t: float) -> DemoResult:
    """Compare the map with the ground truth at time t [s]."""
    xy, elevation = emap.cell_centers()[0], emap.layer("elevation")[0].double()
    error = (elevation - scene.truth(xy, t)).abs()
    is_known, is_hit = error.isfinite(), hit.at(xy)
    return DemoResult(
        rmse=float(error[is_known].square().mean().sqrt()),
        rmse_off_steps=float(error[is_known & ~find_steps(scene, xy, t)].square().mean().sqrt()),
        p95=float(error[is_known].quantile(0.95)),
        coverage=float((is_known & is_hit).sum() / is_hit.sum()),
        ms_per_update=float(torch.tensor(update_ms[_WARM_UP:] or update_ms).median()),
        updates=len(update_ms),
    )


def find_steps(scene: Scene, xy: Tensor, t: float) -> Tensor:
    """Find the cells, given by centres (H, W, 2) [m], in or next to which it rises by more than 5 cm, (H, W)."""
    return steps.find_steps(lambda places: scene.truth(places, t), xy, GRID.resolution, 0.05)


def _draw(out: str | Path, emap: ElevationMap, scene: Scene, path_xy: Tensor, t: float, result: DemoResult) -> None:
    """Write the picture: ground truth, elevation, error, deviation, traversability and upper bound."""
    from torchelev.viz.plot import draw_layers
    from torchelev.viz.style import write

    xy = emap.cell_centers()[0]
    low, high = xy[0, 0] - GRID.resolution / 2, xy[-1, -1] + GRID.resolution / 2
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    title = f"A simulated walk: {result.updates} scans in one map\n{result.accuracy}"
    figure = draw_layers(_make_panels(emap, scene.truth(xy, t)), extent=extent, path_xy=path_xy.numpy(), title=title)
    _label_landmarks(figure.axes[0])
    write(figure, out)


def _label_landmarks(ax: Axes) -> None:
    box = {"boxstyle": "round,pad=0.15", "facecolor": "black", "alpha": 0.55, "linewidth": 0}
    for name, x, y in LANDMARKS:
        ax.text(x, y, name, color="white", fontsize=8, ha="center", va="center", bbox=box)


def _make_panels(emap: ElevationMap, truth: Tensor) -> list[Panel]:
    """Return the panels of the picture; heights share one colour scale."""
    from torchelev.viz.plot import Panel
    from torchelev.viz.style import DEVIATIONS, ERRORS, RATINGS

    layers = {name: emap.layer(name)[0].double() for name in ("elevation", "variance", "traversability", "upper_bound")}
    deviation = (1e3 * layers["variance"].sqrt()).numpy()
    error = (100 * (layers["elevation"] - truth)).numpy()
    traversability = layers["traversability"].numpy()
    low, high = float(truth.min()), float(truth.max())

    def show_heights(title: str, values: Tensor) -> Panel:
        return Panel(title=title, values=values.numpy(), unit="m", vmin=low, vmax=high)

    return [
        show_heights("ground truth and the robot's path", truth),
        show_heights("elevation (grey: unknown)", layers["elevation"]),
        Panel(title="error: elevation - ground truth", values=error, unit="cm", cmap=ERRORS, vmin=-5.0, vmax=5.0),
        Panel(title="standard deviation", values=deviation, unit="mm", cmap=DEVIATIONS, vmin=0.0, vmax=50.0),
        Panel(title="traversability", values=traversability, unit="0: impassable, 1: flat", cmap=RATINGS,
              vmin=0.0, vmax=1.0),
        show_heights("upper bound of unseen ground", layers["upper_bound"]),
    ]  # fmt: skip
