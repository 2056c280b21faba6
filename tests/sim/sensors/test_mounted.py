"""Mounted sensors against closed forms and against the exact scenes; patterns that change, and given intrinsics."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.devices import NoConstants, OneDevice
from tests.helpers import pose, random_poses
from tests.sim.sensors.ray_cases import SURFACES, unit
from torchelev import ElevationMap
from torchelev.inputs.clouds import depth_to_points
from torchelev.sim import DepthCamera, Lidar, mount
from torchelev.sim.exact import scenes
from torchelev.sim.exact.sensors import NonRepetitiveLidar
from torchelev.sim.sensors.casting import Boxes, see
from torchelev.sim.sensors.mounted import MountedSensor
from torchelev.sim.terrains.heightfield import HeightField

CAMERA = DepthCamera(width=16, height=12)
PATTERNS = [CAMERA, Lidar(rings=6, azimuths=32), NonRepetitiveLidar(rays=100)]
FLAT = HeightField(torch.zeros(1, 40, 40), 0.1)


def zeros(num_envs):
    return torch.zeros(num_envs, dtype=torch.int64)


def rough(seed, K=2):
    rng = np.random.default_rng(seed)
    return HeightField(torch.from_numpy(rng.uniform(-0.1, 0.1, (K, 60, 60))), 0.1)


def in_map(sensor, points, T_map_base, T_base_sensor=None):
    T = sensor.T_map_sensor(T_map_base, T_base_sensor)
    return points.double() @ T[:, :3, :3].mT + T[:, None, :3, 3]


@pytest.mark.parametrize("pattern", PATTERNS, ids=lambda pattern: type(pattern).__name__)
@given(seed=st.integers(0, 10_000))
def test_points_lie_on_the_ground(pattern, seed):
    field, T, tiles = rough(seed), random_poses(np.random.default_rng(seed), 3), torch.tensor([1, 0, 1])
    sensor = MountedSensor(pattern, mount())
    points = sensor(field, tiles, T, step=seed)
    assert points.shape[0] == 3 and points.dtype == torch.float32
    hit = points.isfinite().all(-1)
    assert hit.float().mean() > 0.2 and torch.equal(points.isnan().any(-1), ~hit)
    seen = in_map(sensor, points, T).nan_to_num()
    assert ((seen[..., 2] - field.height(tiles, seen[..., :2]))[hit].abs() < 1e-4).all()


@pytest.mark.parametrize("pattern", PATTERNS, ids=lambda pattern: type(pattern).__name__)
def test_sees_what_the_exact_scene_shows(pattern):
    sensor, T = MountedSensor(pattern, mount(35.0, 0.2, 0.3)), pose((0.3, -0.2, 0.6), yaw=0.7, roll=0.1)
    exact = pattern.cast(scenes.flat(), sensor.T_map_sensor(T)[0])
    torch.testing.assert_close(sensor(FLAT, zeros(1), T)[0], exact, atol=1e-4, rtol=1e-5, equal_nan=True)


def test_ranges_by_hand():
    # Straight down from 1 m, and at 60 degrees from that, 2 m to the ground.
    class TwoRays:
        max_range = 5.0
        directions = torch.tensor([[0.0, 0.0, -1.0], [math.sqrt(0.75), 0.0, -0.5]])

    T = pose((0.0, 0.0, 1.0))
    for low, high, seen in ((0.0, None, (1, 2)), (1.5, None, (0, 2)), (0.0, 1.5, (1, 0)), (0.9, 2.1, (1, 2))):
        points = MountedSensor(TwoRays(), torch.eye(4), low, high)(FLAT, zeros(1), T)[0]
        for k, distance in enumerate(seen):
            expected = distance * TwoRays.directions[k] if distance else torch.full((3,), math.nan)
            torch.testing.assert_close(points[k], expected, atol=1e-5, rtol=0, equal_nan=True)


def test_near_hits_block():
    wall = Boxes(pose((0.3, 0.0, 1.0))[None], torch.tensor([[[0.01, 5.0, 5.0]]]))
    sensor = MountedSensor(CAMERA, mount(0.0, 0.0, 0.0), min_range=0.6)
    assert sensor(FLAT, zeros(1), pose((0.0, 0.0, 1.0)), wall).isnan().all()


def test_pose_of_the_sensor():
    mounting, T = mount(20.0, 0.3, 0.2), pose((1.0, 2.0, 3.0), yaw=0.5)
    sensor = MountedSensor(CAMERA, mounting)
    torch.testing.assert_close(sensor.T_map_sensor(T)[0], T[0] @ mounting)
    assert sensor.T_map_sensor(T.float()).dtype == torch.float32


def test_true_mounting_of_each_environment():
    T, true = pose((0.0, 0.0, 0.8), num_envs=2), torch.stack([mount(35.0), mount(25.0, 0.1)])
    believed = MountedSensor(CAMERA, mount(35.0))
    points = believed(FLAT, zeros(2), T, T_base_sensor=true)
    for b in range(2):
        alone = MountedSensor(CAMERA, true[b])(FLAT, zeros(1), T[:1])[0]
        torch.testing.assert_close(points[b], alone, atol=1e-5, rtol=0, equal_nan=True)
    mistaken = in_map(believed, points[1:], T[1:])[..., 2].nan_to_num()
    assert mistaken.abs().max() > 0.05


def test_legs_move_with_the_base():
    # A leg hangs 0.5 m ahead of the base and to its left; the same box is given in the map frame.
    leg = Boxes(pose((0.5, 0.1, -0.2), pitch=0.3)[None].repeat(2, 1, 1, 1), torch.tensor([[[0.05, 0.05, 0.3]]] * 2))
    T = torch.cat([pose((1.0, 0.3, 0.7), yaw=2.0), pose((-0.5, 0.0, 0.9), yaw=-1.0, roll=0.2)])
    sensor = MountedSensor(CAMERA, mount())
    as_leg = sensor(FLAT, zeros(2), T, legs=leg)
    as_box = sensor(FLAT, zeros(2), T, leg._replace(T_map_box=T[:, None] @ leg.T_map_box))
    torch.testing.assert_close(as_leg, as_box, atol=1e-5, rtol=0, equal_nan=True)
    without = sensor(FLAT, zeros(2), T)
    assert 0.01 < ((as_leg - without).norm(dim=-1) > 0.05).float().mean() < 0.5
    person = Boxes(pose((3.0, 0.3, 0.5))[None].repeat(2, 1, 1, 1), torch.full((2, 1, 3), 0.4))
    both, nearer = sensor(FLAT, zeros(2), T, person, legs=leg), sensor(FLAT, zeros(2), T, person)
    distances = [points.norm(dim=-1).nan_to_num(math.inf) for points in (as_leg, nearer, both)]
    torch.testing.assert_close(torch.minimum(*distances[:2]), distances[2], atol=1e-5, rtol=0)


def test_depth_image():
    # Looking straight down from 1 m, every pixel of flat ground is 1 m deep.
    down = MountedSensor(CAMERA, mount(90.0, 0.0, 0.0))
    depth = down.depth(down(FLAT, zeros(2), pose((0.0, 0.0, 1.0), num_envs=2)))
    assert depth.shape == (2, 12, 16)
    torch.testing.assert_close(depth, torch.ones(2, 12, 16), atol=1e-5, rtol=0)
    level = MountedSensor(CAMERA, mount(0.0, 0.0, 0.0), max_range=20.0)
    depth = level.depth(level(FLAT, zeros(1), pose((0.0, 0.0, 1.0))))[0]
    assert depth[:6].isnan().all()  # the upper half sees the sky
    v = torch.arange(6, 12)
    expected = CAMERA.intrinsics[1, 1] / (v - 5.5)  # 1 m below, f / (v - cy) ahead
    near = expected < 10
    torch.testing.assert_close(depth[6:][near], expected[near, None].expand(-1, 16).float(), atol=1e-3, rtol=0)


def test_feeds_a_map():
    emap, sensor, T = ElevationMap(), MountedSensor(DepthCamera(width=60, height=60), mount()), pose((0.0, 0.0, 0.5))
    field = HeightField(torch.full((1, 50, 50), 0.125), 0.1)
    emap.update(sensor(field, zeros(1), T, step=0), sensor.T_map_sensor(T), T, dt=0.0)
    known = emap.layer("elevation")[emap.layer("validity") > 0]
    assert len(known) > 300
    torch.testing.assert_close(known, torch.full_like(known, 0.125), atol=1e-4, rtol=0)


@pytest.mark.slow(1)
def test_host_reads_nothing_back():
    field, T = FLAT.to("meta"), torch.empty(3, 4, 4, device="meta")
    sensors = [MountedSensor(pattern, mount()) for pattern in PATTERNS]
    for sensor in sensors:
        sensor.directions(torch.device("meta"))  # the first call copies the pattern to the device
    legs = Boxes(torch.empty(3, 2, 4, 4, device="meta"), torch.empty(3, 2, 3, device="meta"))
    steps = torch.empty(3, dtype=torch.int64, device="meta")
    with OneDevice(), NoConstants():
        for sensor in sensors:
            assert sensor(field, steps, T, legs, legs=legs, step=steps, T_base_sensor=T).device.type == "meta"


@pytest.mark.parametrize(
    "change, error, text",
    [
        (dict(T_base_sensor=torch.eye(3)), ValueError, "T_base_sensor"),
        (dict(T_base_sensor=2 * torch.eye(4)), ValueError, "T_base_sensor"),
        (dict(min_range=8.0), ValueError, "min_range, max_range"),
        (dict(min_range=-0.1), ValueError, "min_range, max_range"),
        (dict(max_range=math.inf), ValueError, "min_range, max_range"),
    ],
)
def test_refuses_to_be_mounted(change, error, text):
    with pytest.raises(error, match=text):
        MountedSensor(**{**dict(pattern=CAMERA, T_base_sensor=mount()), **change})


def test_refuses_to_look():
    sensor = MountedSensor(CAMERA, mount())
    with pytest.raises(ValueError, match="T_map_base"):
        sensor(FLAT, zeros(2), pose())
    with pytest.raises(ValueError, match="T_map_base: must be finite"):
        sensor(FLAT, zeros(1), pose() * math.nan)
    with pytest.raises(ValueError, match="T_base_sensor"):
        sensor(FLAT, zeros(2), pose(num_envs=2), T_base_sensor=mount())
    with pytest.raises(TypeError, match="pattern: must be an image"):
        MountedSensor(Lidar(), mount()).depth(torch.zeros(1, 32 * 1024, 3))


# Patterns -------------------------------------------------------------------------------------------------------------


def test_camera_of_given_intrinsics():
    camera = DepthCamera.from_intrinsics(20.0, 25.0, 7.25, 4.5, 16, 12, max_range=3.0)
    d = camera.directions.view(12, 16, 3)
    assert camera.max_range == 3.0
    for u, v in ((0, 0), (15, 11), (7, 4), (3, 9)):
        expected = torch.tensor([1.0, (7.25 - u) / 20.0, (4.5 - v) / 25.0], dtype=torch.float64)
        torch.testing.assert_close(d[v, u], expected / expected.norm())
    torch.testing.assert_close(camera.intrinsics, torch.tensor([[20, 0, 7.25], [0, 25, 4.5], [0, 0, 1]]).double())
    # From the left rim of the first pixel, 7.75 pixels from the middle, to the right one of the last, 8.25 from it.
    assert camera.fov_x_deg == pytest.approx(math.degrees(math.atan(7.75 / 20) + math.atan(8.25 / 20)))


def test_camera_of_given_fields_of_view_has_the_same_rays_by_its_intrinsics():
    (fx, _, cx), (_, fy, cy), _ = CAMERA.intrinsics.tolist()
    again = DepthCamera.from_intrinsics(fx, fy, cx, cy, CAMERA.width, CAMERA.height)
    torch.testing.assert_close(again.directions, CAMERA.directions)
    assert (again.fov_x_deg, again.fov_y_deg) == pytest.approx((CAMERA.fov_x_deg, CAMERA.fov_y_deg))


@pytest.mark.parametrize("camera", [CAMERA, DepthCamera.from_intrinsics(20.0, 25.0, 7.25, 4.5, 16, 12)])
def test_depth_images_become_the_points_that_made_them(camera):
    sensor = MountedSensor(camera, mount())
    points = sensor(rough(0), zeros(1), pose((0.0, 0.0, 0.6)))
    right, down, forward = depth_to_points(sensor.depth(points), camera.intrinsics).unbind(-1)
    again = torch.stack([forward, -right, -down], -1)
    torch.testing.assert_close(again, points, atol=1e-5, rtol=1e-5, equal_nan=True)


def test_refuses_focal_lengths():
    with pytest.raises(ValueError, match="fx, fy: must be positive"):
        DepthCamera.from_intrinsics(0.0, 10.0, 1.0, 1.0, 2, 2)


def test_rosette_by_hand():
    lidar = NonRepetitiveLidar(rays=8, fov_deg=60.0, turns=1.0, k=2.0)
    d = lidar.directions(0)
    # theta = 0, 45, 90, ... degrees and rho = 30 cos(2 theta) = 30, 0, -30, 0, ... degrees
    s, c = 0.5, math.sqrt(0.75)
    expected = [[c, s, 0], [1, 0, 0], [c, 0, -s], [1, 0, 0], [c, -s, 0], [1, 0, 0], [c, 0, s], [1, 0, 0]]
    torch.testing.assert_close(d, torch.tensor(expected, dtype=torch.float64), atol=1e-12, rtol=0)


def test_rosette_is_a_sum_of_two_turning_prisms():
    lidar = NonRepetitiveLidar()
    d, n = lidar.directions(3), torch.arange(1024, dtype=torch.float64) + 3 * 1024
    theta = 2 * math.pi * lidar.turns * n / 1024
    half = math.radians(lidar.fov_deg) / 4
    y, z = (half * (f((1 + lidar.k) * theta) + f((1 - lidar.k) * theta)) for f in (torch.cos, torch.sin))
    angle = torch.hypot(y, z)
    torch.testing.assert_close(d[:, 0], angle.cos(), atol=1e-9, rtol=0)
    torch.testing.assert_close(d[:, 1:], torch.stack([y, z], -1) * (angle.sin() / angle)[:, None], atol=1e-9, rtol=0)


def test_rosette_fills_its_view_step_by_step():
    lidar = NonRepetitiveLidar(rays=200)

    def bins(steps):
        d = lidar.directions(torch.arange(steps)).flatten(0, 1)
        return len(torch.unique((d[:, 1:] * 25).floor(), dim=0))

    assert bins(5) > 2.5 * bins(1) and bins(50) > 1.1 * bins(5)
    assert bins(50) > 0.9 * math.pi * (math.sin(math.radians(35.0)) * 25) ** 2
    angle = lidar.directions(torch.arange(50))[..., 0].acos().rad2deg()
    assert 34.9 < float(angle.max()) <= 35.0 + 1e-9


def test_rosette_steps():
    lidar = NonRepetitiveLidar(rays=50)
    steps = torch.tensor([0, 7, 7, 1_000_000])
    d = lidar.directions(steps)
    assert d.shape == (4, 50, 3) and d.dtype == torch.float64
    torch.testing.assert_close(d.norm(dim=-1), torch.ones(4, 50, dtype=torch.float64))
    assert torch.equal(d[1], d[2]) and torch.equal(d[1], lidar.directions(7)) and not torch.equal(d[0], d[1])
    # A late step is as exact as an early one.
    turn = [(50 * 1_000_000 + m) * lidar.turns / 50 for m in range(50)]
    rho = [math.radians(35.0) * math.cos(2 * math.pi * math.fmod(lidar.k * t, 1.0)) for t in turn]
    torch.testing.assert_close(d[3, :, 0], torch.tensor(rho, dtype=torch.float64).cos(), atol=1e-6, rtol=0)


def test_each_environment_has_its_own_step():
    sensor, T = MountedSensor(NonRepetitiveLidar(rays=40), mount()), pose((0.0, 0.0, 1.0), num_envs=2)
    both = sensor(FLAT, zeros(2), T, step=torch.tensor([2, 5]))
    assert (both[0] - both[1]).abs().nan_to_num().max() > 0.1
    for b, step in enumerate((2, 5)):
        alone = sensor(FLAT, zeros(1), T[:1], step=step)[0]
        torch.testing.assert_close(both[b], alone, atol=1e-5, rtol=0, equal_nan=True)


@pytest.mark.parametrize("surface, diagonal", SURFACES)
def test_points_are_the_same_in_cpp(surface, diagonal, monkeypatch):
    """Of more rays than a thread takes, between the ranges, and of no pose that is not finite."""
    rng = np.random.default_rng(3)
    field = HeightField(torch.from_numpy(rng.uniform(-0.2, 0.2, (3, 30, 40))), 0.1, surface, diagonal)
    T = torch.eye(4).repeat(5, 1, 1)
    T[:, :3, :3] = torch.linalg.qr(torch.from_numpy(rng.normal(size=(5, 3, 3))).float())[0]
    T[:, :3, 3] = torch.tensor([[0, 0, 0.4], [1, -1, 0.8], [torch.nan, 0, 1], [1e9, 0, 0.5], [0, 0, -1.0]])
    rays, tile_ids = unit(rng, 1500).float(), torch.tensor([2, 0, 1, 1, 0])
    got = see(field, tile_ids, T, rays, 0.5, 3.0)
    monkeypatch.setenv("TORCHELEV_NATIVE", "0")
    expected = see(field, tile_ids, T, rays, 0.5, 3.0)
    assert got[[0, 1, 3]].isfinite().any(-1).any(-1).all() and got[2].isnan().all()
    differs = ((got - expected).abs() > 1e-4).any(-1) | (got.isnan() != expected.isnan()).any(-1)
    assert differs.float().mean() < 1e-3  # rays along edges
