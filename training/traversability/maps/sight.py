"""The simulated sensors: depth cameras around the body, a lidar on top, or both, with their errors."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.robot import RobotConfig
from torchelev.sim import DepthCamera, HeightField, Lidar, MountedSensor, SensorErrors, mount, mount_on_rim, preset

if TYPE_CHECKING:
    from jaxtyping import Float

_SENSOR_SETS = (("front", "hind"), ("front", "hind", "left", "right"), ("lidar",), ("front", "hind", "lidar"))
_YAWS_DEG = {"front": 0.0, "hind": 180.0, "left": 90.0, "right": -90.0}
_PITCHES = (20.0, 45.0)  # [deg] by which cameras look down
_FOV = (86.0, 58.0)  # [deg] of a camera
_CAMERA_RANGE, _LIDAR_RANGE = 5.0, 12.0  # [m]


class Sight:
    """The sensors of B robots: one random set, each sensor with its own errors.

    Args:
        robot: carries the sensors.
        num: B.
        camera_pixels: width and height of a camera's image.
        lidar_rays: rings and azimuths of the lidar.
        rng: draws set, pitch and errors.
    """

    def __init__(
        self,
        robot: RobotConfig,
        num: int,
        camera_pixels: tuple[int, int],
        lidar_rays: tuple[int, int],
        rng: np.random.Generator,
    ) -> None:
        names = _SENSOR_SETS[int(rng.integers(len(_SENSOR_SETS)))]
        pitch_deg = rng.uniform(*_PITCHES)
        camera, lidar = DepthCamera(*camera_pixels, *_FOV, _CAMERA_RANGE), Lidar(*lidar_rays, max_range=_LIDAR_RANGE)
        top = mount(0.0, z=0.1 + 0.2 * robot.length)
        self.sensors = [
            MountedSensor(lidar, top)
            if name == "lidar"
            else MountedSensor(camera, mount_on_rim(robot.length, robot.width, _YAWS_DEG[name], pitch_deg))
            for name in names
        ]
        kinds = ["spinning_lidar" if name == "lidar" else "depth_camera" for name in names]
        self.errors = [SensorErrors(preset(kind).sensor, num, seed=int(rng.integers(2**31))) for kind in kinds]

    def look(
        self, field: HeightField, T_tile_base: Float[Tensor, "B 4 4"], T_map_base: Float[Tensor, "B 4 4"]
    ) -> tuple[Float[Tensor, "B S N 3"], Float[Tensor, "B S 4 4"]]:
        """Return the points of the S sensors, NaN where a ray hits nothing, and their estimated poses.

        Rays are cast from the true T_tile_base; the poses derive from the estimate T_map_base.
        """
        clouds = []
        tiles = torch.arange(field.num_tiles)
        for sensor, errors in zip(self.sensors, self.errors, strict=True):
            mounting = sensor.T_base_sensor @ errors.mounting().to(sensor.T_base_sensor)
            points = sensor(field, tiles, T_tile_base, T_base_sensor=mounting)
            shape = _image_shape(sensor.pattern)
            clouds.append(errors(points, sensor.T_map_sensor(T_map_base), image_shape=shape))
        max_points = max(cloud.points.shape[1] for cloud in clouds)
        padded = [F.pad(c.points, (0, 0, 0, max_points - c.points.shape[1]), value=math.nan) for c in clouds]
        return torch.stack(padded, 1), torch.stack([cloud.T_map_sensor for cloud in clouds], 1)


def _image_shape(pattern: object) -> tuple[int, int]:
    if isinstance(pattern, Lidar):
        return pattern.rings, pattern.azimuths
    assert isinstance(pattern, DepthCamera)
    return pattern.height, pattern.width
