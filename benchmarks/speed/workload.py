"""What the speed benchmarks run: robots that drive to and fro over ground with a box, every stage on.

Sizes are those of the paper's tables: 10 x 10 m at 4 cm and its sensors' numbers of points, or, for many robots, what
policies are trained on: 64 x 64 cells of 4 cm and 512 points.
"""

from __future__ import annotations

import math
from dataclasses import replace

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
MANY_POINTS = 512  # of each of many robots


def full_config(cells: int = 250) -> ElevationMapConfig:
    """Return the default map at 4 cm, of cells x cells, with the body box on too."""
    body = BodyConfig(lower=(-0.6, -0.3, -0.7), upper=(0.6, 0.3, 0.3))
    length = 0.04 * cells
    return ElevationMapConfig(grid=GridConfig(length_x=length, length_y=length), sensor=SensorConfig(body=body))


def baseline_config() -> ElevationMapConfig:
    """Return transform, noise and height update alone, as the paper's baseline."""
    cfg = full_config()
    fusion, sensor = replace(cfg.fusion, edges=None), replace(cfg.sensor, exclusion=None, body=None)
    return replace(cfg, fusion=fusion, sensor=sensor, drift=None, raycast=None, overlap=None, traversability=None)


def cloud(robots: int, points: int, phase: int, reach: float, generator: torch.Generator) -> Tensor:
    """Make scans (B, N, 3): ground, a box that comes and goes, an overhang, the robot's body, outliers and NaN."""
    size = (robots, points)
    azimuth = torch.rand(size, generator=generator) * 2 * math.pi
    azimuth = torch.where(azimuth < 1, 0.4 * azimuth, azimuth)  # denser towards the box, or 512 points show no edge
    lowest = 0.8 / reach
    fall = lowest + 0.9 * torch.rand(size, generator=generator)  # downward slope of the ray
    r = 0.8 / fall
    z = -0.8 + 0.005 * torch.randn(size, generator=generator)
    x, y = r * azimuth.cos(), r * azimuth.sin()
    near = min(1.5, 0.45 * reach)
    hits_box = (phase % 2 == 0) & (azimuth < 0.4) & (r > near)
    scale = torch.where(hits_box, near / r, 1.0)
    xyz = torch.stack([x * scale, y * scale, torch.where(hits_box, -fall * near, z)], -1)
    which = torch.rand(size, generator=generator)
    xyz[which < 0.01] *= 0.7  # dust
    overhang = (which > 0.01) & (which < 0.02)
    xyz[overhang] = xyz[overhang] * torch.tensor([1.0, 1.0, -1.2])
    body = (which > 0.02) & (which < 0.03)
    xyz[body] = 0.3 * (torch.rand(int(body.sum()), 3, generator=generator) - 0.5)
    xyz[which > 0.99] = torch.nan
    return xyz


class Drive:
    """Robots on their way: every call fuses the next scan of each."""

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
        if compiled:
            self.emap.compile()
        reach = 0.57 * cfg.grid.length_x if reach is None else reach
        self.clouds = [cloud(robots, points, k, reach, generator).to(device) for k in range(scans)]
        # To and fro by a cell a step, sinking and rising by a millimetre.
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
        self.emap.update(points, T, T, self.dt)

    def next_scan(self) -> tuple[Tensor, Tensor]:
        """Return the scans and the poses."""
        k, self.step = self.step, self.step + 1
        return self.clouds[k % len(self.clouds)], self.poses[k % len(self.poses)]

    def watch(self, updates: int) -> None:
        """Run some updates and note what each stage did."""
        for _ in range(updates):
            self()
            for name, value in self.emap.statistics._asdict().items():
                self.seen[name] = max(self.seen.get(name, 0.0), float(value.abs().max()))

    def warm_up(self) -> None:
        """Fill the map and refuse a run in which some stage has nothing to do."""
        self.watch(8)
        # Raise a part of the map by a floor, so that overlap clearance has work.
        part = [slice(3 * n // 10, 7 * n // 20) for n in self.emap.elevation.shape[1:]]
        self.emap.elevation[:, part[0], part[1]] += 3.0
        self.watch(24)
        idle = [name for name, value in self.seen.items() if value == 0]
        assert not idle, f"stages without effect in the warm-up: {idle}"
