"""What the robots of TerrainNav see."""

import dataclasses
import math

import pytest
import torch

from envs.terrain_nav import SightConfig, TerrainNav, TerrainNavConfig
from tests.envs.terrain_nav_cases import FLAT, SMALL
from torchelev.observations.fill import FILLS
from torchelev.sim import SensorErrorConfig, SensorErrors


@pytest.mark.slow(1)
@pytest.mark.parametrize("perception", ["map", "truth", "blind"])
def test_observations_have_the_same_shapes_are_fresh_and_finite(perception):
    task = TerrainNav(TerrainNavConfig(course=SMALL), 3, perception=perception)
    first = task.observe()
    kept = {name: value.clone() for name, value in first.items()}
    shapes = {name: tuple(value.shape) for name, value in first.items()}
    image = (3, 4, 16, 16)
    assert shapes == {"policy": (3, 12), "map": image, "truth": image}
    for _ in range(4):
        task.advance(torch.ones(3, 2))
        task.sense()
        assert all(bool(value.isfinite().all()) for value in task.observe().values())
    for name, value in first.items():
        assert torch.equal(value, kept[name]), f"{name} changed after it was returned"


@pytest.mark.slow(1)
def test_truth_is_the_ground_at_the_crops_pixels():
    task = TerrainNav(TerrainNavConfig(course=SMALL), 2, perception="truth", seed=5)
    image = task.observe()["truth"]
    field, T = task.course.field, task.T_map_base
    for env in range(2):
        for i, j in [(0, 0), (3, 12), (15, 15), (8, 2)]:
            ahead, left = 0.8 + (i + 0.5 - 8) * 0.2, (j + 0.5 - 8) * 0.2
            yaw = float(task.yaw[env])
            x = float(task.xy[env, 0]) + math.cos(yaw) * ahead - math.sin(yaw) * left
            y = float(task.xy[env, 1]) + math.sin(yaw) * ahead + math.cos(yaw) * left
            ground = float(field.height(task.tile_ids[env : env + 1], torch.tensor([[[x, y]]])))
            expected = ground - (float(T[env, 2, 3]) - 0.45)
            assert float(image[env, 0, i, j]) == pytest.approx(expected, abs=2e-3)
    assert torch.equal(image[:, 0], image[:, 1]) and bool((image[:, 2] == 1).all())


@pytest.mark.slow(1)
def test_white_noise_is_uniform_and_new_at_each_look():
    task = TerrainNav(TerrainNavConfig(course=SMALL), 64, perception="truth")
    seen = task.observe()
    error = seen["map"][:, 0] - seen["truth"][:, 0]
    assert 0.099 < float(error.abs().max()) <= 0.1 + 1e-6
    assert float(error.std()) == pytest.approx(0.1 / 3**0.5, rel=0.05)
    assert torch.equal(task.observe()["map"], seen["map"])
    task.sense()
    assert not torch.equal(task.observe()["map"], seen["map"])


@pytest.mark.slow(1)
def test_blind_sees_nothing():
    task = TerrainNav(TerrainNavConfig(course=SMALL), 2, perception="blind")
    assert float(task.observe()["map"].abs().max()) == 0.0


def test_the_map_shows_the_ground_where_errors_are_none():
    sight = SightConfig(sensor_errors="perfect", pose_errors="perfect")
    task = TerrainNav(TerrainNavConfig(course=dataclasses.replace(FLAT, roughness=0.05), sight=sight), 8)
    for _ in range(5):
        task.advance(torch.tensor([[0.5, 0.3]]).expand(8, 2))
        task.sense()
    seen = task.observe()
    known = seen["map"][:, 2] > 0
    assert float(known.float().mean()) > 0.3
    error = (seen["map"][:, 0] - seen["truth"][:, 0])[known].abs()
    assert float(error.median()) < 0.01 and float(error.quantile(0.99)) < 0.05


@pytest.mark.slow(1)
def test_rays_start_where_cameras_are_and_points_go_where_odometry_says():
    task = TerrainNav(TerrainNavConfig(course=SMALL, sight=SightConfig(sensor_errors="perfect")), 3)
    for _ in range(5):
        task.advance(torch.ones(3, 2))
        task.sense()
    sight, T = task.sight, task.T_map_base
    assert float((sight.T_estimated - T).abs().max()) > 1e-3
    bent = SensorErrorConfig(mounting_position=0.1, mounting_rotation_deg=2.0)
    sight.sensor_errors = torch.nn.ModuleList(SensorErrors(bent, 3, seed=k) for k in range(len(sight.cameras)))
    points, poses = sight.look(T, task.tile_ids)
    for k, (camera, errors) in enumerate(zip(sight.cameras, sight.sensor_errors, strict=True)):
        seen = camera(task.course.field, task.tile_ids, T, T_base_sensor=camera.T_base_sensor @ errors.mounting())
        torch.testing.assert_close(points[:, k], seen, equal_nan=True)
        torch.testing.assert_close(poses[:, k], sight.T_estimated @ camera.T_base_sensor)


@pytest.mark.slow(1)
def test_each_look_casts_from_the_true_pose(monkeypatch):
    task = TerrainNav(TerrainNavConfig(course=SMALL), 3)
    asked, look = [], task.sight.look
    monkeypatch.setattr(task.sight, "look", lambda T, tile_ids: asked.append(T) or look(T, tile_ids))
    task.advance(torch.ones(3, 2))
    task.sense()
    torch.testing.assert_close(asked[0], task.T_map_base)


@pytest.mark.slow(1)
def test_the_map_is_placed_by_odometry_that_drifts():
    task = TerrainNav(TerrainNavConfig(course=FLAT), 8)
    errors = []
    for _ in range(20):
        task.advance(torch.tensor([[1.0, 0.2]]).expand(8, 2))
        task.sense()
        errors.append((task.sight.T_estimated - task.T_map_base)[:, :2, 3].norm(dim=-1))
    assert float(errors[-1].min()) > 1e-3 and float(errors[-1].mean()) > 2 * float(errors[0].mean())
    expected = torch.linalg.vector_norm(task.goal - task.xy, dim=-1) / 5  # where the goal is does not drift
    torch.testing.assert_close(task.observe()["policy"][:, 2], expected)


@pytest.mark.slow(2)
@pytest.mark.parametrize("fill", FILLS)
def test_a_fill_changes_the_elevation_of_unknown_pixels_alone(fill):
    plain, filled = (
        TerrainNav(TerrainNavConfig(course=SMALL, sight=SightConfig(fill=name)), 3) for name in ("base", fill)
    )
    for task in (plain, filled):
        for _ in range(3):
            task.advance(torch.ones(3, 2))
            task.sense()
    image, usual = filled.observe()["map"], plain.observe()["map"]
    known = usual[:, 2] == 1
    assert 0.1 < float(known.float().mean()) < 0.9
    assert torch.equal(image[:, 1:], usual[:, 1:]) and not bool(usual[:, 0][~known].any())
    torch.testing.assert_close(image[:, 0][known], usual[:, 0][known], atol=1e-6, rtol=0)
    assert bool(image[:, 0][~known].any()) == (fill != "base")


@pytest.mark.slow(1)
def test_each_camera_sees_from_its_own_mounting():
    """Cast together, the cameras see what each would see alone."""
    cfg = TerrainNavConfig(course=SMALL, sight=SightConfig(sensor_errors="perfect", pose_errors="perfect"))
    task = TerrainNav(cfg, 3)
    sight, T = task.sight, task.T_map_base
    points, poses = sight.look(T, task.tile_ids)
    assert points.shape[:2] == (3, 2) and not torch.equal(points[:, 0], points[:, 1])
    for k, camera in enumerate(sight.cameras):
        seen = camera(task.course.field, task.tile_ids, T)
        torch.testing.assert_close(points[:, k], seen, rtol=0, atol=1e-5, equal_nan=True)
        torch.testing.assert_close(poses[:, k], camera.T_map_sensor(sight.T_estimated))
