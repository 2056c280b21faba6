"""Every set of sensors sees the ground."""

import numpy as np
import torch

from tests.helpers import pose
from torchelev.robot import RobotConfig
from torchelev.sim import HeightField
from training.traversability.maps.sight import Sight
from training.traversability.maps.terrain import (
    RESOLUTION,
)


def test_every_set_of_sensors_sees_the_ground_from_the_believed_poses():
    field, robot = HeightField(torch.zeros(1, 401, 401), RESOLUTION), RobotConfig()
    counts = set()
    for seed in range(12):
        sight = Sight(robot, 1, (16, 12), (8, 64), np.random.default_rng(seed))
        T_tile_base, T_map_base = pose((0.0, 0.0, 0.5)), pose((5.0, 5.0, 2.5), yaw=1.0)
        for _ in range(4):  # clouds may come late
            points, T_map_sensor = sight.look(field, T_tile_base, T_map_base)
        ground = points.double() @ T_map_sensor[..., :3, :3].mT + T_map_sensor[..., None, :3, 3]
        seen = ground[..., 2][ground[..., 2].isfinite()]
        assert abs(float(seen.median()) - 2.0) < 0.1
        counts.add(points.shape[1])
    assert counts == {1, 2, 3, 4}
