"""A simulated drive over rough ground whose lidar turns while the robot moves, with the true poses at any time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchelev.frames import interpolate_poses
from torchelev.sim import HeightField, Lidar
from torchelev.sim.poses import mount, pose
from torchelev.sim.sensors.casting import Boxes, cast
from torchelev.sim.waves import Waves, natural_waves

PERIOD = 0.1  # [s] of a scan
LIDAR = Lidar(rings=32, azimuths=1024, fov_low_deg=-25.0, fov_high_deg=15.0, max_range=50.0)
T_BASE_LIDAR = mount(12.0, x=0.3, z=0.6)  # looks down a little, as on many robots
_RESOLUTION, _RATE = 0.1, 200.0  # [m] of the ground, [Hz] of the true poses
_HEIGHT, _REACH = 0.3, 0.4  # [m] of the base above the ground, and half the distance between wheels
GRAVITY = 9.81  # [m/s^2]


class RollingScan(NamedTuple):
    """The points of a turn of a lidar, each from the lidar's pose at its time."""

    stamp: float  #: [s] begin of the turn
    points: NDArray[np.float32]  #: (N, 3) [m] sensor frame, NaN where there is no return
    times: NDArray[np.float64]  #: (N,) [s] from the stamp


@dataclass(frozen=True)
class Drive:
    """A drive along an S-shaped path, from a standstill.

    Args:
        distance: [m] length of the path.
        speed: [m/s] that is reached after 2 s.
        swing: [rad] amplitude of the heading.
        relief: scale of the ground's waves; 0 is a plane.
        rocks: number of blocks of 0.3 to 3 m height beside the path.
        noise: [m] standard deviation of ranges.
        walls: boxes as rows x, y, z of the centre and half the side lengths [m].
        lidar: pattern of rays.
        seed: of ground and noise.
    """

    distance: float = 100.0
    speed: float = 1.2
    swing: float = 0.7
    relief: float = 1.0
    rocks: int = 160
    noise: float = 0.02
    walls: tuple[tuple[float, ...], ...] = ()
    lidar: Lidar = LIDAR
    seed: int = 0

    @property
    def num_scans(self) -> int:
        """Number of scans."""
        return int((self.times[-1].item() - 2 * PERIOD) / PERIOD)

    @cached_property
    def times(self) -> Tensor:
        """Times (K,) [s] of the true poses."""
        return torch.arange(0.0, self.distance / self.speed + 1.0, 1 / _RATE, dtype=torch.float64)

    @cached_property
    def _path(self) -> Tensor:
        """Place and heading (K, 3) [m, rad] of the robot: the speed grows for 2 s, and the heading swings."""
        s = self.speed * torch.where(self.times < 2.0, self.times**2 / 4, self.times - 1.0)
        heading = self.swing * torch.sin(2 * math.pi * s / 40.0)
        step = torch.diff(s, prepend=s[:1])
        return torch.stack([(step * heading.cos()).cumsum(0), (step * heading.sin()).cumsum(0), heading], -1)

    @cached_property
    def ground(self) -> tuple[HeightField, Tensor]:
        """The ground, and the centre (2,) [m] of its tile."""
        low, high = self._path[:, :2].amin(0) - 40.0, self._path[:, :2].amax(0) + 40.0
        shape = ((high - low) / _RESOLUTION).long() + 1
        x, y = (low[a] + _RESOLUTION * torch.arange(int(shape[a]), dtype=torch.float64) for a in (0, 1))
        X, Y = torch.meshgrid(x, y, indexing="ij")
        z = self.relief * self._waves(X, Y)
        for x0, y0, length, width, height in self._rocks(low, high):
            inside = ((X - x0).abs() < length) & ((Y - y0).abs() < width)
            z[inside] = z[inside].mean() + height if inside.any() else 0.0
        return HeightField(z[None].float(), _RESOLUTION), torch.stack([x.mean(), y.mean()])

    def _waves(self, x: Tensor, y: Tensor) -> Tensor:
        hills = Waves([0.5, 0.3, 0.15], [37.0, 19.0, 9.0], [0.4, 2.1, 1.2], [0.3, 1.0, 2.0])
        return natural_waves(self.seed)(x, y) + hills(x, y)

    def _rocks(self, low: Tensor, high: Tensor) -> Iterator[list[float]]:
        """Draw x, y, half length, half width, height [m] of blocks that leave 3 m beside the path free."""
        generator, made = torch.Generator().manual_seed(self.seed), 0
        while made < self.rocks:
            u = torch.rand(5, generator=generator, dtype=torch.float64)
            place = low + u[:2] * (high - low)
            if (self._path[::20, :2] - place).norm(dim=1).min() > 4.0:
                made += 1
                yield [*place.tolist(), 0.2 + float(u[2]), 0.2 + float(u[3]), 0.3 + 2.7 * float(u[4]) ** 3]

    def height(self, xy: Tensor) -> Tensor:
        """Return the true height (M,) [m] of the ground at xy (M, 2) [m]."""
        field, center = self.ground
        return field.height(torch.zeros(1, dtype=torch.int64), (xy - center)[None]).double()[0]

    @cached_property
    def bases(self) -> Tensor:
        """Poses (K, 4, 4) of the base at `times`: it stands on its wheels, and sways by 1 degree."""
        x, y, heading = self._path.T
        ahead, left = (
            torch.stack([f(heading + turn) for f in (torch.cos, torch.sin)], -1) for turn in (0, math.pi / 2)
        )
        xy = torch.stack([x, y], -1)
        front, back, one, other = (self.height(xy + _REACH * d) for d in (ahead, -ahead, left, -left))
        sway = math.radians(1.0) * torch.sin(2 * math.pi * 1.3 * self.times)
        place = torch.cat([xy, ((front + back + one + other) / 4 + _HEIGHT)[:, None]], -1)
        return pose(place, heading, torch.atan2(back - front, torch.tensor(2 * _REACH)) + sway,
                    torch.atan2(one - other, torch.tensor(2 * _REACH)) + 0.6 * sway)  # fmt: skip

    def base_at(self, times: Tensor) -> Tensor:
        """Return the true poses (M, 4, 4) of the base at times (M,) [s]."""
        return interpolate_poses(self.bases[None], self.times[None], times.double()[None])[0]

    def lidar_at(self, times: Tensor) -> Tensor:
        """Return the true poses (M, 4, 4) of the lidar at times (M,) [s]."""
        return self.base_at(times) @ T_BASE_LIDAR

    def scan(self, index: int) -> RollingScan:
        """Return a scan: each azimuth is measured from the pose at its time."""
        lidar, stamp = self.lidar, 0.5 * PERIOD + PERIOD * index
        columns = lidar.directions.view(lidar.rings, lidar.azimuths, 3).movedim(1, 0)
        times = PERIOD * torch.arange(lidar.azimuths, dtype=torch.float64) / lidar.azimuths
        T = self.lidar_at(stamp + times)
        field, center = self.ground
        shift = torch.cat([center, center.new_zeros(1)])
        rays = T[:, :3, 3] - shift, (columns @ T[:, :3, :3].mT).float()
        boxes = self._boxes(shift, len(T))
        ranges = cast(field, torch.zeros(len(T), dtype=torch.int64), *rays, lidar.max_range, boxes).double()
        generator = torch.Generator().manual_seed(1000 * self.seed + index)
        ranges += self.noise * torch.randn(ranges.shape, generator=generator, dtype=torch.float64)
        points = columns * torch.where(ranges.isfinite(), ranges, torch.nan)[..., None]
        each = times[:, None].expand(-1, lidar.rings)
        return RollingScan(stamp, points.flatten(0, 1).float().numpy(), each.flatten().numpy().copy())

    def _boxes(self, shift: Tensor, count: int) -> Boxes | None:
        """Return the walls around the centre of the ground's tile, once for each azimuth."""
        if not self.walls:
            return None
        rows = torch.tensor(self.walls)
        boxes = Boxes(pose(rows[:, :3].double() - shift, torch.zeros(len(rows))), rows[:, 3:])
        return Boxes(*(value.float().expand(count, *value.shape) for value in boxes))

    def accelerations(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return times (M,) [s] and specific forces (M, 3) [m/s^2] as an IMU in the base measures them."""
        place, step = self.bases[:, :3, 3], 1 / _RATE
        acceleration = (place[2:] - 2 * place[1:-1] + place[:-2]) / step**2
        force = acceleration + torch.tensor([0.0, 0.0, GRAVITY], dtype=torch.float64)
        return self.times[1:-1].numpy(), (force[:, None] @ self.bases[1:-1, :3, :3])[:, 0].numpy()
