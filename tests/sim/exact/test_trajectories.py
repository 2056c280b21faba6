"""Paths are rigid, go where they should, and drift by what was asked."""

import math

import pytest
import torch

from torchelev.sim import MOUNT, sink, turn_on_the_spot, walk
from torchelev.sim.exact import scenes

PATH = [(-1.0, 0.0), (1.5, 0.0), (1.5, 1.0)]


def rigid(T):
    R = T[..., :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R))
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(len(T), dtype=torch.float64))
    assert bool((T[:, 3] == torch.tensor([0, 0, 0, 1.0])).all())


@pytest.mark.parametrize(
    "path", [turn_on_the_spot(), walk(scenes.mixed(0), PATH), walk(scenes.flat(), PATH).then(turn_on_the_spot())]
)
def test_rigid_float64_and_mounted(path):
    for T in (path.T_map_base, path.T_map_sensor):
        assert T.dtype == torch.float64
        rigid(T)
    torch.testing.assert_close(path.T_map_sensor, path.T_map_base @ MOUNT)
    assert len(path.times) == len(path.T_map_base)
    torch.testing.assert_close(path.times.diff(), torch.full_like(path.times[1:], 0.1))


def test_turn_stands_at_the_height_over_the_ground():
    path = turn_on_the_spot(0.8, n=12, scene=scenes.slope(), at=(1.0, 0.0))
    torch.testing.assert_close(path.T_map_sensor[:, 2, 3], torch.full((12,), 0.8 + math.tan(math.radians(15))).double())


def test_walk_visits_the_corners_at_its_speed():
    path = walk(scenes.flat(), PATH, speed=0.5, dt=0.1)
    xy = path.T_map_base[:, :2, 3]
    for corner in PATH:
        assert float((xy - torch.tensor(corner)).norm(dim=-1).min()) < 1e-6
    assert float(xy.diff(dim=0).norm(dim=-1).max()) < 0.0501
    heading = torch.atan2(path.T_map_base[:, 1, 0], path.T_map_base[:, 0, 0])
    assert float(heading.diff().abs().max()) < 0.101


def test_walk_follows_the_ground():
    path = walk(scenes.slope(10.0), [(-1.0, 0.0), (2.0, 0.0)], sway=0.0)
    T = path.T_map_base
    torch.testing.assert_close(T[:, 2, 3], 0.55 + math.tan(math.radians(10.0)) * T[:, 0, 3])
    torch.testing.assert_close(torch.asin(T[:, 2, 0]), torch.full((len(T),), math.radians(10.0)).double())
    across = walk(scenes.slope(10.0), [(0.0, -1.0), (0.0, 1.0)], sway=0.0).T_map_base
    torch.testing.assert_close(torch.asin(across[:, 2, 1]), torch.full((len(across),), -math.radians(10.0)).double())


def test_gait_sways():
    z = walk(scenes.flat(), PATH).T_map_base[:, 2, 3]
    assert 0.01 < float((z - 0.55).abs().max()) <= 0.015 + 1e-9


def test_sink_changes_height_alone():
    T = walk(scenes.rough(0), PATH).T_map_base
    drifted = sink(T, total=0.15)
    torch.testing.assert_close(T[-1, 2, 3] - drifted[-1, 2, 3], torch.tensor(0.15).double())
    drifted[:, 2, 3] = T[:, 2, 3]
    torch.testing.assert_close(drifted, T, atol=0, rtol=0)
