"""Rays at the robot's own body: against a march along the reference's shapes, by hand, and in mounted sensors."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from tests.devices import NoConstants, OneDevice, never_wait
from tests.helpers import pose
from tests.robot_body.bodies import any_poses, as_reference, random_body
from tests.sim.sensors.ray_cases import unit
from tests.stages.test_body import own_points
from torchelev import Box, Capsule, RobotBody
from torchelev.sim import DepthCamera, HeightField, Lidar, MountedSensor, mount
from torchelev.sim.sensors import body_casting
from torchelev.sim.sensors.body_casting import cast_at_body
from torchelev.sim.sensors.casting import Boxes

SEEDS = st.integers(0, 10_000)
FLAT = HeightField(torch.zeros(1, 40, 40), 0.1)
TILES = torch.zeros(1, dtype=torch.int64)
REST = pose((0.0, 0.0, 0.0))


@pytest.mark.slow(1)
@given(SEEDS)
def test_agrees_with_the_reference(seed):
    rng = np.random.default_rng(seed)
    body = random_body(rng, capsules=2, boxes=1)
    T_base_sensor, links = any_poses(rng, 1, reach=0.5), any_poses(rng, 1, len(body.links), reach=0.3)
    R, origin = T_base_sensor[0, :3, :3].numpy(), T_base_sensor[0, :3, 3].numpy()
    aim = links[0, rng.integers(len(body.links), size=20), :3, 3].numpy() + rng.normal(0, 0.1, (20, 3)) - origin
    aim = aim / np.linalg.norm(aim, axis=1, keepdims=True)
    got = cast_at_body(body, T_base_sensor, links, torch.from_numpy(aim @ R)[None])[0]
    robot = as_reference(body, REST[0], links[0])
    for ray, distance in zip(aim, got.tolist(), strict=True):
        assert distance == pytest.approx(reference.first_hit(origin, ray, *robot, reach=3.0), abs=1e-4)


@pytest.mark.slow(1)
@given(SEEDS)
def test_hits_are_the_robots_own_points_and_nothing_before_them_is(seed):
    rng = np.random.default_rng(seed)
    body = random_body(rng, padding=0.0, depth_tolerance=1e-4)
    T_base_sensor, links = any_poses(rng, 2, reach=1.5), any_poses(rng, 2, len(body.links), reach=0.3)
    rays = unit(rng, 2, 400)
    distance = cast_at_body(body, T_base_sensor, links, rays)
    poses = T_base_sensor[:, None], REST.expand(2, 4, 4), links
    at_hit = own_points(body, (rays * distance[..., None].nan_to_num(posinf=1.0))[:, None], *poses)
    assert at_hit[distance.isfinite()].all()
    before = (rays * (distance.nan_to_num(posinf=4.0) * rng.random())[..., None])[:, None]
    holds_sensor = own_points(body, torch.full((2, 1, 1, 3), 1e-3), *poses)
    assert holds_sensor.any() or not own_points(body, before, *poses).any()


LEG = Capsule(link="a", start=(0.0, 0.0, -1.0), end=(0.0, 0.0, 1.0), radius=0.1)
BALL = Capsule(link="a", start=(0.0, 0.0, 0.0), end=(0.0, 0.0, 0.0), radius=0.1)
BLOCK = Box(link="a", center=(0.0, 0.0, 0.0), half_lengths=(0.1, 0.2, 0.3))


@pytest.mark.parametrize(
    "shape, ray, expected",
    [
        (LEG, [1.0, 0, 0], 1.9),
        (LEG, [1.0, 0.04, 0], math.hypot(1, 0.04) * (2 - math.sqrt(0.01 * 1.0016 - 0.0064)) / 1.0016),
        (LEG, [1.0, 0.06, 0], math.inf),
        (LEG, [-1.0, 0, 0], math.inf),
        (BALL, [1.0, 0, 0], 1.9),
        (BALL, [1.0, 0, 0.06], math.inf),
        (BLOCK, [1.0, 0, 0], 1.9),
        (BLOCK, [1.0, 0.1, 0], 1.9 * math.hypot(1, 0.1)),
        (BLOCK, [1.0, 0.11, 0], math.inf),
    ],
)
def test_by_hand(shape, ray, expected, path):
    """A shape 2 m ahead."""
    body = RobotBody(**{"boxes" if shape is BLOCK else "capsules": (shape,)}, padding=0.5)
    rays = torch.nn.functional.normalize(torch.tensor([[ray]], dtype=torch.float64), dim=-1)
    got = cast_at_body(body, REST, pose((2.0, 0.0, 0.0))[:, None], rays)
    assert got.item() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("down, expected", [(1.0, math.inf), (-1.0, 1.9)])
def test_rays_along_the_axis_of_a_capsule(down, expected, path):
    """The end's sphere, 3 m less 1 m and 0.1 m, whether or not rounding makes the ray parallel."""
    body = RobotBody(capsules=(LEG,))
    for tilt in (0.0, 1e-8, 1e-5, 1e-4):
        ray = torch.nn.functional.normalize(torch.tensor([[[tilt, -tilt, down]]], dtype=torch.float64), dim=-1)
        got = cast_at_body(body, REST, pose((0.0, 0.0, -3.0))[:, None], ray)
        assert got.item() == pytest.approx(expected, abs=1e-4)
    beside = cast_at_body(body, REST, pose((0.11, 0.0, -3.0))[:, None], torch.tensor([[[0.0, 0.0, -1.0]]]))
    assert beside.isinf().all()


@pytest.mark.parametrize("shape", [LEG, BALL, BLOCK])
def test_a_shape_that_holds_the_sensor_hides_nothing(shape, path):
    wall = Box(link="b", center=(0.0, 0.0, 0.0), half_lengths=(0.1, 5.0, 5.0))
    around = {"boxes": (wall, shape)} if shape is BLOCK else {"boxes": (wall,), "capsules": (shape,)}
    body = RobotBody(**around)
    links = torch.stack([pose((0.05, 0.0, 0.0))[0] if link == "a" else pose((1.0, 0, 0))[0] for link in body.links])
    got = cast_at_body(body, REST, links[None], torch.tensor([[[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]]))
    assert got[0].tolist() == [pytest.approx(0.9), math.inf]


@given(SEEDS)
def test_only_capsules_far_from_a_ray_are_left_out(seed):
    rng = np.random.default_rng(seed)
    body = random_body(rng, capsules=3, boxes=0)
    inputs = body, any_poses(rng, 4, reach=0.5), any_poses(rng, 4, len(body.links), reach=0.3), unit(rng, 4, 200)
    near = cast_at_body(*inputs)
    with pytest.MonkeyPatch.context() as patch:
        never_wait(patch)
        every = cast_at_body(*inputs)
    torch.testing.assert_close(near, every, rtol=0, atol=1e-6)


def test_parts_make_the_whole():
    rng = np.random.default_rng(0)
    body = random_body(rng)
    many = body_casting.MAX_PAIRS // (2 * (len(body.capsules) + len(body.boxes)))  # two environments at a time
    poses, rays = (any_poses(rng, 5), any_poses(rng, 5, len(body.links))), unit(rng, 5, many)
    whole = cast_at_body(body, *poses, rays[:, :70])
    assert 0 < whole.isfinite().sum() < whole.numel()
    assert torch.equal(cast_at_body(body, *poses, rays)[:, :70], whole)


# Mounted sensors ------------------------------------------------------------------------------------------------------

ROBOT = RobotBody(
    capsules=(Capsule(link="leg", start=(0.0, 0.0, 0.0), end=(0.0, 0.0, -0.4), radius=0.04),),
    boxes=(Box(link="base", center=(0.0, 0.0, 0.0), half_lengths=(0.2, 0.1, 0.05)),),
)
LINKS = torch.cat([pose((0.45, 0.05, 0.0), pitch=0.2), REST])[None]


@pytest.mark.slow(1)
@pytest.mark.parametrize("pattern", [DepthCamera(width=32, height=24), Lidar(rings=8, azimuths=64)])
@given(seed=SEEDS)
def test_the_nearer_of_body_and_ground_is_seen(pattern, seed):
    rng = np.random.default_rng(seed)
    sensor, T = (
        MountedSensor(pattern, mount(40.0, 0.22, 0.1)),
        pose((rng.uniform(-1, 1), 0.3, 0.5), yaw=rng.uniform(-3, 3)),
    )
    view = sensor.view(FLAT, TILES, T, body=ROBOT, T_base_links=LINKS)
    ground = sensor(FLAT, TILES, T)
    assert torch.equal(sensor(FLAT, TILES, T, body=ROBOT, T_base_links=LINKS).nan_to_num(), view.points.nan_to_num())
    assert 0.005 < view.on_body.double().mean() < 0.9
    torch.testing.assert_close(view.points[~view.on_body], ground[~view.on_body], rtol=0, atol=5e-6, equal_nan=True)
    assert (view.points.norm(dim=-1) < ground.norm(dim=-1).nan_to_num(math.inf))[view.on_body].all()
    tight = RobotBody(capsules=ROBOT.capsules, boxes=ROBOT.boxes, padding=1e-5, depth_tolerance=0.0)
    own = own_points(tight, view.points[:, None].double(), sensor.T_map_sensor(T)[:, None], T, LINKS)
    assert torch.equal(own & view.points.isfinite().all(-1), view.on_body)


def test_the_true_mounting_is_where_the_sensor_looks_from():
    true, T = mount(50.0, 0.2, 0.15, yaw_deg=5.0)[None], pose((0.0, 0.0, 0.5))
    believed = MountedSensor(DepthCamera(width=32, height=24), mount(40.0, 0.22, 0.1))
    seen = believed(FLAT, TILES, T, T_base_sensor=true, body=ROBOT, T_base_links=LINKS)
    alone = MountedSensor(believed.pattern, true[0])(FLAT, TILES, T, body=ROBOT, T_base_links=LINKS)
    torch.testing.assert_close(seen, alone, atol=1e-5, rtol=0, equal_nan=True)


def test_obstacles_and_ranges_count_as_before():
    """A person before the leg hides it; a leg beyond the range, or nearer than the least, returns nothing."""
    T, camera = pose((0.0, 0.0, 0.5)), DepthCamera(width=32, height=24)
    sensor = MountedSensor(camera, mount(10.0, 0.22, 0.0))
    person = Boxes(pose((0.3, 0.0, 0.5))[None], torch.tensor([[[0.01, 5.0, 5.0]]]))
    assert not sensor.view(FLAT, TILES, T, person, body=ROBOT, T_base_links=LINKS).on_body.any()
    short = MountedSensor(camera, sensor.T_base_sensor, max_range=0.1).view(
        FLAT, TILES, T, body=ROBOT, T_base_links=LINKS
    )
    assert not short.on_body.any() and short.points.isnan().all()
    far = MountedSensor(camera, sensor.T_base_sensor, min_range=1.0).view(
        FLAT, TILES, T, body=ROBOT, T_base_links=LINKS
    )
    assert far.on_body.any() and far.points[far.on_body].isnan().all()


def test_refuses():
    sensor = MountedSensor(Lidar(), mount())
    with pytest.raises(ValueError, match=r"T_base_links: expected \(1, 2, 4, 4\), .* of leg, base, got None"):
        sensor(FLAT, TILES, REST, body=ROBOT)
    with pytest.raises(ValueError, match=r"T_base_links: expected \(1, 2, 4, 4\)"):
        sensor(FLAT, TILES, REST, body=ROBOT, T_base_links=LINKS[:, :1])
    with pytest.raises(ValueError, match=r"T_base_links: .*without body"):
        sensor(FLAT, TILES, REST, T_base_links=LINKS)


@pytest.mark.slow(1)
def test_host_reads_nothing_back():
    sensor = MountedSensor(DepthCamera(width=8, height=6), mount())
    field, T = FLAT.to("meta"), torch.empty(3, 4, 4, device="meta")
    sensor.directions(torch.device("meta"))  # the first call copies the pattern to the device
    links, tiles = torch.empty(3, 2, 4, 4, device="meta"), torch.empty(3, dtype=torch.int64, device="meta")
    with OneDevice(), NoConstants():
        view = sensor.view(field, tiles, T, body=ROBOT, T_base_links=links)
    assert view.points.device.type == view.on_body.device.type == "meta"
