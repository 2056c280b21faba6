"""What the quadruped sees: true heights, their noise, the map."""

import dataclasses

import pytest
import torch

from envs.quadruped import Quadruped
from envs.quadruped.config import SightConfig
from envs.quadruped.height_noise import HeightNoise
from envs.quadruped.sight import make_sensors, sensor_errors
from tests.envs.quadruped.cases import CFG, FLAT_CFG
from torchelev.sim import preset


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


@pytest.mark.slow(1)
def test_the_map_reads_the_ground_that_it_has_seen():
    task = Quadruped(CFG, 4, perception="map", seed=1)
    task.place_at(torch.ones(4, dtype=torch.int64))
    task.physics.state[:, 1] += 1.2  # [m] from the middle to the stairs
    ground = task.terrain.field.height(task.tile_ids, task.T_map_base[:, None, :2, 3])
    task.physics.state[:, 3] = ground[:, 0].double() + 0.34
    for _ in range(40):
        task.advance(torch.zeros(4, 12))
        task.sense()
    _, valid = task.sight.scan(task.sight.emap, task.view().T_estimated)
    seen = task.observe()
    error = (seen["height_scan"] - seen["true_height_scan"]).abs()
    for k, kind in enumerate(CFG.terrain.kinds):
        known = valid & (task.kind == k)[:, None]
        assert known.sum() > 0.4 * 2 * 187 and error[known].median() < 0.02, kind
    assert (seen["true_height_scan"][task.kind == 1].std(-1) > 0.05).all(), "no plane that a guess could meet"


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


def test_true_heights_keep_the_clip_of_the_scan():
    task = Quadruped(CFG, 1, perception="blind")
    view = task.view()
    task.truth.scan = dataclasses.replace(task.truth.scan, clip=0.01, nominal_height=0.0)
    read = task.truth.read(view)
    torch.testing.assert_close(read["height_scan"], torch.full((1, 187), 0.01))
    task.truth.foot_scan = dataclasses.replace(task.truth.foot_scan, clip=None)
    assert torch.equal(task.truth.read(view)["feet"], read["feet"])


def test_resets_need_no_synchronisation():
    sight = Quadruped(CFG, 2, perception="map").sight
    given = []
    sight.emap.reset = lambda *args, **kwargs: given.append((args, kwargs))
    mask = torch.tensor([True, False])
    sight.reset(mask)
    assert given == [((), {"mask": mask})]


def with_sight(**changes):
    return dataclasses.replace(CFG, sight=dataclasses.replace(CFG.sight, **changes))


def test_a_lidar_is_a_preset_with_errors_of_its_own():
    cfg = with_sight(sensors="lidar")
    assert len(make_sensors(cfg)) == 1 and len(make_sensors(CFG)) == 2
    task = Quadruped(cfg, 1, perception="map")
    for _ in range(8):
        task.advance(torch.zeros(1, 12))
        task.sense()
    assert task.sight.emap.layer("validity").sum() > 100
    seen = task.sight.look(task.view())
    hit, kept = (points.isfinite().all(-1) for points in (seen.ideal, seen.points))
    assert kept.sum() > 0.9 * hit.sum()
    behind = hit & (seen.ideal[..., 0] < -0.3)
    assert kept[behind].sum() > 0.9 * behind.sum() > 50


def test_only_cameras_pick_pixels_that_straddle_edges():
    lidar, camera = sensor_errors(with_sight(sensors="lidar")), sensor_errors(CFG)
    assert lidar.flying == preset("spinning_lidar").sensor.flying
    assert camera.flying[1] == pytest.approx(0.8 * CFG.sight.camera_pixels[0] / 848)
    assert camera.disparity_step > 0 and lidar.disparity_step == 0


def test_sensors_that_do_not_fit_are_refused():
    words = r"sight.sensor_errors: must not be those of a camera if sensors='lidar', got 'depth_camera'; leave it out"
    with pytest.raises(ValueError, match=words):
        SightConfig(sensors="lidar", sensor_errors="depth_camera")
    with pytest.raises(ValueError, match="sight.sensors: must be one of depth_cameras, lidar"):
        SightConfig(sensors="sonar")
