"""Levels by tensors and in C++, on the same scans: the same surfaces, the same ground, the same points set aside."""

import os
from unittest import mock

import pytest
import torch

from tests.levels.walks import line, look, make_map
from torchelev import BodyConfig, LevelsConfig, SensorConfig
from torchelev.levels.state import Levels
from torchelev.sim.exact import covered_scenes

PATHS = {
    "table": line((-1.0, 0.0, 0.0), (2.0, 0.2, 0.0), 6),
    "stairwell": [(0.3 + 0.29 * k, 0.6, 0.17 * (k + 1)) for k in range(6)],
    "door": line((0.0, 0.0, 0.0), (2.5, 0.1, 0.0), 5),
    "bridge": line((0.0, -2.0, 0.0), (0.0, 0.5, 0.0), 5),
    "branches": line((0.0, 0.0, 0.0), (1.5, 0.0, 0.0), 4),
}


def update_by_tensors(emap, *given, **settings):
    with mock.patch.dict(os.environ, TORCHELEV_NATIVE="0"):
        emap.update(*given, **settings)


def require_equal(a, b):
    for name in Levels._fields:
        torch.testing.assert_close(getattr(a.levels, name), getattr(b.levels, name), rtol=0, atol=2e-5, msg=name)
    assert torch.equal(a.validity, b.validity)
    torch.testing.assert_close(a.elevation, b.elevation, rtol=0, atol=2e-5)
    assert torch.equal(a.levels.corner, b.levels.corner)
    for name, number in a.levels.statistics._asdict().items():
        assert torch.equal(number, getattr(b.levels.statistics, name)), name


@pytest.mark.slow(3)
@pytest.mark.parametrize("name", PATHS)
def test_tensors_and_cpp_agree(name):
    scene, settings = getattr(covered_scenes, name)(), {}
    if name == "door":
        settings = dict(sensor=SensorConfig(body=BodyConfig()), levels=LevelsConfig(max_levels=4, separation="gap"))
    fast, tensors = make_map(**settings), make_map(**settings)
    for k, place in enumerate(PATHS[name]):
        given = look(scene, *place, seed=k, yaw=0.2 * k)
        fast.update(*given, dt=0.4)
        update_by_tensors(tensors, *given, dt=0.4)
        require_equal(fast, tensors)
    assert (fast.levels.support > 0).sum() > 10


@pytest.mark.slow(2)
def test_they_agree_with_several_maps_sensors_and_variances():
    scene, maps = covered_scenes.table(), [make_map(2), make_map(2)]
    for k in range(3):
        clouds = [look(scene, x, y, seed=9 * k + s) for s, (x, y) in enumerate(((0.1 * k, 0.0), (1.0, -0.1 * k)))]
        points, T_map_sensor, T_map_base = (torch.cat(parts) for parts in zip(*clouds, strict=True))
        points = torch.stack([points, points.roll(7, 1)], 1)
        T_map_sensor = torch.stack([T_map_sensor, T_map_sensor], 1)
        variance = torch.full(points.shape[:3], 1e-4)
        for emap, update in zip(maps, (type(maps[0]).update, update_by_tensors), strict=True):
            update(emap, points, T_map_sensor, T_map_base, dt=0.2, variance=variance)
        require_equal(*maps)


def test_without_a_base_the_window_stays_and_nothing_is_chosen():
    maps = [make_map(), make_map()]
    points, T_map_sensor, _ = look(covered_scenes.table(), 0.3, 0.0)
    for emap, update in zip(maps, (type(maps[0]).update, update_by_tensors), strict=True):
        update(emap, points, T_map_sensor, dt=0.1)
    require_equal(*maps)
    assert int(maps[0].levels.statistics.chosen) == 0
    assert (maps[0].levels.support > 0).any()


@pytest.mark.parametrize("update", [None, update_by_tensors])
def test_a_pose_that_is_not_finite_changes_nothing(update):
    emap = make_map()
    points, T_map_sensor, T_map_base = look(covered_scenes.table(), 0.3, 0.0)
    emap.update(points, T_map_sensor, T_map_base, dt=0.1)
    before = {name: getattr(emap.levels, name).clone() for name in ("lower", "upper", "support", "free_top")}
    with pytest.raises(ValueError):
        emap.update(points, T_map_sensor * torch.nan, T_map_base, dt=0.1)
    assert all(torch.equal(value, getattr(emap.levels, name)) for name, value in before.items())


def test_levels_that_are_not_contiguous_are_updated_by_tensors():
    plain, moved = make_map(), make_map().to(memory_format=torch.channels_last)
    assert plain.backend.name == "CPU" and "the levels are not contiguous" in moved.backend.reason
    for k in range(2):
        given = look(covered_scenes.table(), 0.3 * k, 0.0, seed=k)
        for emap in (plain, moved):
            emap.update(*given, dt=0.1)
    require_equal(plain, moved)


def test_a_sensor_may_be_far_from_the_window():
    emap = make_map()
    points, T_map_sensor, T_map_base = look(covered_scenes.table(), 0.3, 0.0)
    away = torch.eye(4, dtype=torch.float64)
    away[0, 3] = 5e8
    emap.update(points, away @ T_map_sensor, T_map_base, dt=0.1)
    assert not (emap.levels.support > 0).any()
    emap.update(points, T_map_sensor, T_map_base, dt=0.1)
    assert (emap.levels.support > 0).any()
