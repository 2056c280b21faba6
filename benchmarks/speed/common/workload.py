"""The workload of the speed benchmarks: robots that drive back and forth over ground with a box, every stage on.

One robot has the sizes of the paper's tables, 10 x 10 m at 4 cm and the points of its sensors; many robots have those
of policy training, 64 x 64 cells of 4 cm and 512 points each.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from dataclasses import replace
from unittest import mock

import torch
from torch import Tensor

from torchelev import BodyConfig, ElevationMap, ElevationMapConfig, GridConfig, SensorConfig

# The paper's Table II: sensor, points, its map update rate on a Jetson Xavier [Hz], the sensor's rate [Hz].
SENSORS = [
    ("Realsense filtered", 6276, 49.4, 60),
    ("Realsense raw", 407040, 16.1, 60),
    ("Bpearl", 43074, 19.99, 20),
]
BPEARL = 43074
MANY_POINTS = 512  # per robot, with many robots


def full_config(cells: int = 250) -> ElevationMapConfig:
    """Return the default configuration at 4 cm with `cells` x `cells` cells, and the body box."""
    body = BodyConfig(lower=(-0.6, -0.3, -0.7), upper=(0.6, 0.3, 0.3))
    length = 0.04 * cells
    return ElevationMapConfig(grid=GridConfig(length_x=length, length_y=length), sensor=SensorConfig(body=body))


def baseline_config() -> ElevationMapConfig:
    """Return the paper's baseline: point transform, noise and height update only."""
    cfg = full_config()
    fusion, sensor = replace(cfg.fusion, edges=None), replace(cfg.sensor, exclusion=None, body=None)
    return replace(cfg, fusion=fusion, sensor=sensor, drift=None, raycast=None, overlap=None, traversability=None)


def _cloud(robots: int, points: int, phase: int, reach: float, generator: torch.Generator) -> Tensor:
    """Make scans (B, N, 3): ground, a box in every second scan, an overhang, the robot's body, outliers and NaN."""
    size = (robots, points)
    azimuth = torch.rand(size, generator=generator) * 2 * math.pi
    azimuth = torch.where(
        azimuth < 1, 0.4 * azimuth, azimuth
    )  # denser towards the box, so that 512 points show its edges
    lowest = 0.8 / reach
    slope = lowest + 0.9 * torch.rand(size, generator=generator)  # of the ray, downwards
    r = 0.8 / slope
    z = -0.8 + 0.005 * torch.randn(size, generator=generator)
    x, y = r * azimuth.cos(), r * azimuth.sin()
    near = min(1.5, 0.45 * reach)
    hits_box = (phase % 2 == 0) & (azimuth < 0.4) & (r > near)
    scale = torch.where(hits_box, near / r, 1.0)
    xyz = torch.stack([x * scale, y * scale, torch.where(hits_box, -slope * near, z)], -1)
    kind = torch.rand(size, generator=generator)
    xyz[kind < 0.01] *= 0.7  # dust
    overhang = (kind > 0.01) & (kind < 0.02)
    xyz[overhang] = xyz[overhang] * torch.tensor([1.0, 1.0, -1.2])
    body = (kind > 0.02) & (kind < 0.03)
    xyz[body] = 0.3 * (torch.rand(int(body.sum()), 3, generator=generator) - 0.5)
    xyz[kind > 0.99] = torch.nan
    return xyz


@contextlib.contextmanager
def by_tensors() -> Iterator[None]:
    """Let the library run by tensors."""
    with mock.patch.dict(os.environ, {"TORCHELEV_NATIVE": "0"}):
        yield


class Drive:
    """Robots that drive; each call fuses the next scan of every robot.

    Args:
        cfg: the map's configuration.
        points: number of points of a scan.
        robots: number of environments.
        compiled: run updates by compiled code, else by tensors.
        device: where the map and the scans are.
        scans: number of scans; they repeat.
        reach: longest horizontal distance of a point [m]; None: a little beyond the window's border.
    """

    def __init__(
        self,
        cfg: ElevationMapConfig,
        points: int,
        robots: int = 1,
        compiled: bool = True,
        device: str = "cpu",
        scans: int = 8,
        reach: float | None = None,
    ) -> None:
        generator = torch.Generator().manual_seed(0)
        self.emap = ElevationMap(cfg, robots, device)
        self.compiled = compiled
        reach = 0.57 * cfg.grid.length_x if reach is None else reach
        self.clouds = [_cloud(robots, points, k, reach, generator).to(device) for k in range(scans)]
        # Back and forth by one cell per step; the height changes by a millimetre.
        steps = torch.arange(280, dtype=torch.float64)
        T = torch.eye(4, dtype=torch.float64).repeat(280, 1, 1)
        T[:, 0, 3], T[:, 2, 3] = 0.04 * (steps % 40 - 20).abs(), 0.8 + 0.001 * (steps % 7)
        self.poses = [pose.expand(robots, 4, 4) for pose in T.to(device)]
        self.dt = torch.full((robots,), 0.6, device=device)
        self.step = 0
        self.seen: dict[str, float] = {}

    def __call__(self) -> None:
        """Fuse the next scan."""
        points, T = self.next_scan()
        with contextlib.nullcontext() if self.compiled else by_tensors():
            self.emap.update(points, T, T, self.dt)

    def next_scan(self) -> tuple[Tensor, Tensor]:
        """Return the next scans (B, N, 3) and poses (B, 4, 4)."""
        k, self.step = self.step, self.step + 1
        return self.clouds[k % len(self.clouds)], self.poses[k % len(self.poses)]

    def watch(self, updates: int) -> None:
        """Run updates and record the largest value of each statistic."""
        for _ in range(updates):
            self()
            for name, value in self.emap.statistics._asdict().items():
                self.seen[name] = max(self.seen.get(name, 0.0), float(value.abs().max()))

    def warm_up(self) -> None:
        """Fill the map; raise AssertionError if a stage had nothing to do."""
        self.watch(8)
        # Raise a part of the map by a floor, so that overlap clearance has something to clear.
        part = [slice(3 * n // 10, 7 * n // 20) for n in self.emap.state.elevation.shape[1:]]
        self.emap.state.elevation[:, part[0], part[1]] += 3.0
        self.watch(24)
        idle = [name for name, value in self.seen.items() if value == 0]
        assert not idle, f"stages without effect in the warm-up: {idle}"
