from collections import Counter

import numpy as np
import pytest
import torch

from torchelev.io.odometry import GRAVITY, OdometryError, Track, align, up_from_ground, up_from_imu
from torchelev.sim.poses import pose

UP = pose(torch.zeros(3, dtype=torch.float64), 0.4, 0.3, -0.2).numpy()[:3, :3].T @ [0.0, 0.0, 1.0]  # in the sensor


def ground(tilted, noise=0.03):
    """Points of a plane 1 m below a sensor, and of a wall."""
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-8, 8, (3000, 2)), rng.normal(-1, noise, 3000)])
    wall = np.column_stack([np.full(1500, 4.0), rng.uniform(-8, 8, 1500), rng.uniform(-1, 4, 1500)])
    return np.concatenate([floor, wall]) @ tilted


def speeding_up(acceleration=1.0):
    """A track of 4 s that speeds up along x of a sensor whose frame is tilted."""
    times = 100.0 + np.arange(0.0, 4.05, 0.1)
    T = np.tile(np.eye(4), (len(times), 1, 1))
    T[:, 0, 3] = acceleration * (times - 100.0) ** 2 / 2
    return Track(times, times, T, np.zeros((0, 3)), Counter())


def test_up_is_the_normal_of_the_ground():
    tilt = pose(torch.zeros(3, dtype=torch.float64), 0.4, 0.3, -0.2).numpy()[:3, :3]
    up = up_from_ground(ground(tilt), np.array([0.0, 0.0, 1.0]))
    assert np.degrees(np.arccos(up @ tilt[2])) < 0.5


def test_there_is_no_ground_among_walls_alone():
    rng = np.random.default_rng(0)
    walls = np.column_stack([np.full(2000, 4.0), rng.uniform(-8, 8, 2000), rng.uniform(-1, 4, 2000)])
    assert up_from_ground(walls, np.array([0.0, 0.0, 1.0])) is None


@pytest.mark.parametrize("unit", [1.0, 1 / GRAVITY])
def test_up_is_against_gravity_also_while_the_robot_speeds_up(unit):
    track, times = speeding_up(), 100.0 + np.arange(0.0, 4.0, 0.01)
    forces = np.tile(GRAVITY * UP + [1.0, 0.0, 0.0], (len(times), 1)) * unit
    up = up_from_imu(track, times, forces, np.eye(3))
    assert np.degrees(np.arccos(np.clip(up @ UP, -1, 1))) < 0.5


def test_an_imu_without_gravity_is_refused():
    times = 100.0 + np.arange(0.0, 4.0, 0.01)
    with pytest.raises(OdometryError, match="neither 9.81 m/s"):
        up_from_imu(speeding_up(), times, np.full((len(times), 3), 0.02), np.eye(3))


def test_the_map_looks_ahead_and_up():
    R = align(UP, np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(R @ UP, [0.0, 0.0, 1.0], atol=1e-12)
    ahead = R @ [1.0, 0.0, 0.0]
    assert ahead[0] > 0 and abs(ahead[1]) < 1e-12
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
