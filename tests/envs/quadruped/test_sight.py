"""What the quadruped sees: true heights, their noise, the map."""

import dataclasses

import pytest
import torch

from envs.quadruped import Quadruped
from envs.quadruped.height_noise import HeightNoise
from envs.quadruped.sight import make_sensors
from tests.envs.quadruped.cases import CFG, FLAT_CFG


def test_true_heights_are_those_below_the_pattern():
    task = Quadruped(CFG, 2, perception="blind", seed=3)
    for _ in range(10):
        task.advance(torch.zeros(2, 12))
    view = task.view()
    read = task.truth.read(view)
    T = view.T_map_base
    for k in range(2):
        yaw = torch.atan2(T[k, 1, 0], T[k, 0, 0])
        cos, sin = yaw.cos(), yaw.sin()
        for p, (x, y) in enumerate(task.truth.scan.pattern):
            place = torch.stack([T[k, 0, 3] + cos * x - sin * y, T[k, 1, 3] + sin * x + cos * y])
            height = task.terrain.field.height(task.tile_ids[k : k + 1], place.view(1, 1, 2))[0, 0]
            expected = (T[k, 2, 3] - height - CFG.gait.body_height).clamp(-1, 1)
            torch.testing.assert_close(read["height_scan"][k, p], expected, atol=1e-4, rtol=0)


def test_foot_rings_on_flat_ground_read_the_height_of_each_foot():
    task = Quadruped(FLAT_CFG, 2, perception="truth", seed=3)
    view = task.view()
    expected = view.feet_in(view.T_map_base)[..., 2]
    read = task.truth.read(view)["feet"].unflatten(1, (4, -1))
    torch.testing.assert_close(read, expected[..., None].expand_as(read), atol=1e-5, rtol=0)


def test_the_map_reads_the_ground_that_it_has_seen():
    task = Quadruped(FLAT_CFG, 2, perception="map", seed=1)
    for _ in range(40):
        task.advance(torch.zeros(2, 12))
        task.sense()
    seen = task.observe()
    error = (seen["height_scan"] - seen["true_height_scan"]).abs()
    assert error.median() < 0.02


def test_blind_robots_read_zeros_in_the_same_shapes():
    shapes = {}
    for perception in ("map", "truth", "blind"):
        observed = Quadruped(CFG, 1, perception=perception).observe(critic=False)
        shapes[perception] = {name: tuple(value.shape) for name, value in observed.items()}
        if perception == "blind":
            assert not observed["height_scan"].any() and not observed["feet"].any()
    assert shapes["map"] == shapes["truth"] == shapes["blind"]


def test_observations_share_no_memory_with_the_map():
    task = Quadruped(CFG, 1, perception="map")
    before = task.observe()
    kept = {name: value.clone() for name, value in before.items()}
    for _ in range(8):
        task.advance(torch.zeros(1, 12))
        task.sense()
    for name, value in before.items():
        assert torch.equal(value, kept[name]), name


def test_height_noise_has_the_published_spread():
    noise = HeightNoise(20000, 2, "cpu")
    noise.reset(torch.ones(20000, dtype=torch.bool))
    fractions = torch.bincount(noise.kind) / 20000
    torch.testing.assert_close(fractions, torch.tensor([0.6, 0.3, 0.1]), atol=0.02, rtol=0)
    for kind, sigma in enumerate((0.04, 0.1, 0.3)):
        assert float(noise.offset[noise.kind == kind][..., 2].std()) == pytest.approx(sigma, rel=0.05)
    noisy = noise.disturb(torch.zeros(20000, 4), 0) - noise.offset[:, 0, 2:]
    for kind, (sigma, share, far) in enumerate(((0.005, 0.02, 0.03), (0.005, 0.02, 0.1), (0.1, 0.05, 0.3))):
        expected = (sigma**2 + share * far**2) ** 0.5
        assert float(noisy[noise.kind == kind].std()) == pytest.approx(expected, rel=0.1)


def test_height_offsets_hold_through_an_episode():
    noise = HeightNoise(4, 1, "cpu")
    noise.reset(torch.ones(4, dtype=torch.bool))
    before = noise.offset.clone()
    noise.reset(torch.tensor([True, False, False, False]))
    assert torch.equal(noise.offset[1:], before[1:]) and not torch.equal(noise.offset[:1], before[:1])


def test_a_lidar_is_a_preset():
    cfg = dataclasses.replace(
        CFG, sight=dataclasses.replace(CFG.sight, sensors="lidar", sensor_errors="spinning_lidar")
    )
    assert len(make_sensors(cfg)) == 1 and len(make_sensors(CFG)) == 2
    task = Quadruped(cfg, 1, perception="map")
    for _ in range(8):
        task.advance(torch.zeros(1, 12))
        task.sense()
    assert task.sight.emap.layer("validity").sum() > 100
    with pytest.raises(ValueError, match="sight.sensors: must be one of depth_cameras, lidar"):
        dataclasses.replace(CFG, sight=dataclasses.replace(CFG.sight, sensors="sonar"))
