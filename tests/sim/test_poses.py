"""Transforms from angles, and where sensors sit on a robot."""

import math

import numpy as np
import pytest
import torch

from tests.helpers import rotation
from torchelev.sim import MOUNT, mount, mount_on_rim
from torchelev.sim.poses import pose, pose_from_rotation_vector


@pytest.mark.parametrize("seed", range(5))
def test_pose_turns_by_yaw_pitch_and_roll(seed):
    angles = dict(zip(("yaw", "pitch", "roll"), np.random.default_rng(seed).uniform(-3, 3, 3), strict=True))
    T = pose(torch.tensor([1.0, 2.0, 3.0]), **angles)
    assert T.dtype == torch.float64 and T[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(T[:3, :3], rotation(**angles), atol=1e-12)
    assert T[:3, 3].tolist() == [1.0, 2.0, 3.0]


def test_rotation_vectors_by_hand():
    vector = torch.tensor([[0.0, 0.0, math.pi / 2], [math.pi, 0.0, 0.0], [0.0, 0.0, 0.0]])
    T = pose_from_rotation_vector(vector, torch.tensor([[1.0, 2.0, 3.0]]).expand(3, 3))
    torch.testing.assert_close(T[0, :3, :3], torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), atol=1e-6, rtol=0)
    torch.testing.assert_close(T[1, :3, :3], torch.diag(torch.tensor([1.0, -1, -1])), atol=1e-6, rtol=0)
    torch.testing.assert_close(T[2, :3, :3], torch.eye(3), atol=0, rtol=0)
    assert T[:, :3, 3].tolist() == [[1.0, 2.0, 3.0]] * 3


def test_mount_looks_down():
    forward = torch.tensor([math.cos(math.radians(35)), 0, -math.sin(math.radians(35))])
    torch.testing.assert_close(MOUNT[:3, 0], forward.double())


def test_mount_is_the_pose_of_a_sensor_that_looks_aside():
    T = mount(30.0, 0.2, 0.4, y=-0.1, yaw_deg=90.0)
    assert T[:3, 3].tolist() == [0.2, -0.1, 0.4]
    np.testing.assert_allclose(T[:3, :3], rotation(yaw=math.pi / 2, pitch=math.radians(30.0)), atol=1e-12)


@pytest.mark.parametrize("yaw_deg, place", [(0.0, (0.5, 0.0)), (90.0, (0.0, 0.2)), (180.0, (-0.5, 0.0))])
def test_sensors_on_the_rim_look_outwards(yaw_deg, place):
    T = mount_on_rim(1.0, 0.4, yaw_deg, 20.0)
    np.testing.assert_allclose(T[:3, 3], [*place, 0.05], atol=1e-12)
    outwards = np.array(place) / np.linalg.norm(place)
    np.testing.assert_allclose(T[:2, 0], math.cos(math.radians(20.0)) * outwards, atol=1e-12)
    assert float(T[2, 0]) == pytest.approx(-math.sin(math.radians(20.0)))
