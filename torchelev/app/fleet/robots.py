"""Simulated robots that walk along paths and see the ground with spinning lidars. Where to walk is not decided here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchelev.app.fleet.world import World, make_camp
from torchelev.sim import Lidar, MountedSensor, PoseErrorConfig, PoseErrors, SensorErrorConfig, SensorErrors, mount
from torchelev.sim.poses import pose

if TYPE_CHECKING:
    from jaxtyping import Float

SPEED = 1.25  # [m/s]
CAMP_SPACING = 2.0  # [m] between robots at the start
_BASE_HEIGHT = 0.5  # [m] above the ground
_LIDAR = Lidar(rings=36, azimuths=96, fov_low_deg=-75.0, fov_high_deg=-4.0, max_range=6.5)
_T_BASE_LIDAR = mount(pitch_deg=0.0, z=0.35)
_RANGE_NOISE = SensorErrorConfig(range_constant=0.015)
#: Each robot's odometry has its own error of height, which also drifts: by 2 cm in 100 s. Its x, y and yaw are exact.
_HEIGHT_ERROR = PoseErrorConfig(bias_z=(-0.15, 0.15), drift_z_time=0.002)


class Scan(NamedTuple):
    """Clouds of all robots at one time, and their estimated poses."""

    points: Float[Tensor, "B N 3"]  #: [m] sensor frame
    T_map_sensor: Float[Tensor, "B 4 4"]  #: estimated
    T_map_base: Float[Tensor, "B 4 4"]  #: estimated
    height_error: Float[Tensor, "B"]  #: [m] of the estimated poses


class Robots:
    """Robots that start in a camp.

    Args:
        world: the terrain.
        num_robots: B.
        seed: of their errors.

    Attributes:
        xy: (B, 2) [m] true positions.
        tracks: positions (B, 2) [m] after each step, the first at the start.
    """

    def __init__(self, world: World, num_robots: int, seed: int) -> None:
        self.world = world
        self.xy = make_camp(num_robots, CAMP_SPACING).numpy()
        self.yaw = np.arctan2(self.xy[:, 1], self.xy[:, 0])
        self.tracks = [self.xy.copy()]
        self._paths: list[NDArray] = [np.zeros((0, 2))] * num_robots
        self._sensor = MountedSensor(_LIDAR, _T_BASE_LIDAR)
        self._noise = SensorErrors(_RANGE_NOISE, num_robots, seed=seed)
        self._odometry = PoseErrors(_HEIGHT_ERROR, num_robots, seed=seed)
        self._spin = torch.Generator().manual_seed(seed)
        self._tiles = torch.zeros(num_robots, dtype=torch.int64)

    def __len__(self) -> int:
        return len(self.xy)

    def follow(self, paths: Sequence[NDArray]) -> None:
        """Take paths (K, 2) [m] to walk along from now on; an empty one means to stay."""
        self._paths = list(paths)

    def walk(self, dt: float) -> None:
        """Walk along the paths for dt [s]."""
        for robot, path in enumerate(self._paths):
            place, self._paths[robot] = advance(self.xy[robot], path, SPEED * dt)
            step = place - self.xy[robot]
            if step.any():
                self.yaw[robot] = math.atan2(step[1], step[0])
            self.xy[robot] = place
        self.tracks.append(self.xy.copy())

    def sense(self, dt: float) -> Scan:
        """See the ground, dt [s] after the scan before."""
        true = self._true_poses()
        points = self._sensor(self.world.field, self._tiles, true, T_base_sensor=self._mountings())
        estimated = self._odometry(true, dt)
        points, _ = self._noise(points)
        T_map_sensor = estimated @ self._T_base_sensor
        return Scan(points, T_map_sensor, estimated, (estimated - true)[:, 2, 3])

    def _true_poses(self) -> Float[Tensor, "B 4 4"]:
        xy = torch.as_tensor(self.xy)
        z = self.world.truth(xy).double() + _BASE_HEIGHT
        return pose(torch.cat([xy, z[:, None]], 1), torch.as_tensor(self.yaw))

    def _mountings(self) -> Float[Tensor, "B 4 4"]:
        """Turn each lidar by a part of its azimuth step, as its motor is not synchronised with the scans."""
        phase = torch.rand(len(self), generator=self._spin).double() * 2 * math.pi / _LIDAR.azimuths
        self._T_base_sensor = _T_BASE_LIDAR @ pose(torch.zeros(len(self), 3, dtype=torch.float64), phase)
        return self._T_base_sensor


def advance(place: NDArray, path: NDArray, distance: float) -> tuple[NDArray, NDArray]:
    """Return where `distance` [m] along a path (K, 2) [m] leads from a place (2,), and the rest of the path."""
    while len(path) and distance > 0:
        step = path[0] - place
        length = float(np.hypot(*step))
        if length > distance:
            return place + step * (distance / length), path
        place, path, distance = path[0], path[1:], distance - length
    return place.copy(), path
