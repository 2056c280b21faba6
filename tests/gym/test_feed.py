"""The feed by itself: what a simulator's own loop gets from its maps, without a wrapper."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.gym.test_wrappers import CONFIG, DT, LAYERS, cloud_of, pose_of
from torchelev import Capsule, ElevationMap, HeightScan, RobotBody, SensorConfig
from torchelev.gym import MapFeed


class Simulator:
    """Two robots; the second begins a new episode at step 2."""

    step = 0

    def places(self):
        return [(0, 1, self.step), (1, 1 + (self.step >= 2), self.step % 2 if self.step >= 2 else self.step)]


def points(sim):
    return torch.stack([torch.from_numpy(cloud_of(*place)) for place in sim.places()])


def pose(sim):
    return torch.stack([torch.from_numpy(pose_of(count)) for _, _, count in sim.places()])


SOURCES = dict(points=points, T_map_sensor=pose, T_map_base=pose, dt=DT, cfg=CONFIG)


def test_maps_begin_with_their_episodes():
    sim, feed, scan = Simulator(), MapFeed(2, **SOURCES, read=HeightScan.isaac_lab()), HeightScan.isaac_lab()
    feed.observe(sim, torch.ones(2, dtype=torch.bool), stepped=False)
    for sim.step in (1, 2, 3):
        seen = feed.observe(sim, torch.tensor([False, sim.step == 2]), stepped=True)
    for i, clouds in enumerate([[(0, 1, t) for t in range(4)], [(1, 2, 0), (1, 2, 1)]]):
        alone = ElevationMap(CONFIG)
        for k, place in enumerate(clouds):
            T = torch.from_numpy(pose_of(place[2]))[None]
            alone.update(torch.from_numpy(cloud_of(*place))[None], T, T, dt=DT if k else 0.0)
        for name in LAYERS:
            mine, expected = feed.emap.layer(name)[i], alone.layer(name)[0]
            torch.testing.assert_close(mine, expected, rtol=0, atol=1e-6, equal_nan=True)
        torch.testing.assert_close(seen[i, 0], scan(alone, T)[0][0], rtol=0, atol=1e-6)


def test_a_reset_of_some_fuses_their_clouds_alone():
    sim, feed = Simulator(), MapFeed(2, **SOURCES)
    feed.observe(sim, torch.ones(2, dtype=torch.bool), stepped=False)
    before = {name: feed.emap.layer(name)[0] for name in LAYERS}
    sim.step = 2
    feed.observe(sim, torch.tensor([False, True]), stepped=False)
    moved = ElevationMap(CONFIG)  # the window follows the robot, nothing is fused
    T = [torch.from_numpy(pose_of(step))[None] for step in (0, 2)]
    moved.update(torch.from_numpy(cloud_of(0, 1, 0))[None], T[0], T[0], dt=0.0)
    moved.update(torch.full((1, 1, 3), torch.nan), T[1], T[1], dt=0.0)
    for name in before:
        torch.testing.assert_close(feed.emap.layer(name)[0], moved.layer(name)[0], rtol=0, atol=1e-6, equal_nan=True)


def test_links_are_posed_by_their_function():
    """All points lie on a ball of 9 m around the base."""
    ball = Capsule(link="a", start=(0, 0, 0), end=(0, 0, 0), radius=9.0)
    cfg = dataclasses.replace(CONFIG, sensor=SensorConfig(body=RobotBody(capsules=(ball,))))
    feed = MapFeed(2, **SOURCES | dict(cfg=cfg), T_base_links=lambda sim: np.eye(4)[None].repeat(2, 0)[:, None])
    feed.observe(Simulator(), torch.ones(2, dtype=torch.bool), stepped=False)
    assert (feed.emap.statistics.rejected_body > 0).all() and not feed.emap.validity.any()
    for options in (dict(cfg=cfg), dict(T_base_links=pose)):
        with pytest.raises(ValueError, match="T_base_links: must be a function if cfg.sensor.body has links"):
            MapFeed(2, **SOURCES | options)


def test_it_needs_a_time_and_poses():
    with pytest.raises(TypeError, match="dt"):
        MapFeed(2, points=points, T_map_sensor=pose, T_map_base=pose)
    with pytest.raises(ValueError, match="num_envs"):
        MapFeed(0, points=points, T_map_sensor=pose, T_map_base=pose, dt=DT)
    with pytest.raises(ValueError, match="dt: must be seconds, got True"):
        MapFeed(2, points=points, T_map_sensor=pose, T_map_base=pose, dt=True)
    assert MapFeed(2, points=points, T_map_sensor=pose, T_map_base=pose, dt=np.float32(DT)).dt == np.float32(DT)
    with pytest.raises(ValueError, match="T_map_base: must be a function of the environment, got NoneType"):
        MapFeed(2, points=points, T_map_sensor=pose, T_map_base=None, dt=DT)


def test_what_a_reader_may_return():
    arrays = lambda emap, T: (np.zeros((2, 3)), np.ones((2, 3)))  # noqa: E731
    feed = MapFeed(2, points=points, T_map_sensor=pose, T_map_base=pose, dt=DT, read=arrays)
    with pytest.raises(ValueError, match=r"read: must return a tensor \(2, ...\), got tuple"):
        feed.read_blank()
