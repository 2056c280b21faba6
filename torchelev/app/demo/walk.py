"""The simulated walk of the demo: a robot with a depth camera on a course, and the map that it makes."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torchelev.app.demo.course import ROUTE, make_course
from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.grid import GridConfig
from torchelev.sim import DepthCamera, Scene, Trajectory, mount, outliers, range_noise, walk

SPEED, DT = 0.8, 0.2  # [m/s], [s]
# Pitched less than a camera for footholds would be, so that it sees the overhead bar in front of the robot.
CAMERA, T_BASE_CAMERA = DepthCamera(max_range=6.0), mount(pitch_deg=20.0)
GRID = GridConfig(resolution=0.04, length_x=12.0, length_y=9.6)


class DemoScan(NamedTuple):
    """One depth image with its poses."""

    points: Tensor  #: (N, 3) [m] sensor frame
    T_map_sensor: Tensor  #: (4, 4)
    T_map_base: Tensor  #: (4, 4)
    time: float  #: [s] since the start


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
