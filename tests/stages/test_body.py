"""The self-filter by links: against the reference, what it keeps and removes, and in every kind of update."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from tests.devices import unread
from tests.helpers import differences, mapped, pose, small_config, small_map, snapshot
from tests.robot_body.bodies import any_poses, as_reference, random_body
from torchelev import Box, Capsule, ElevationMap, RobotBody, SensorConfig

SEEDS = st.integers(0, 10_000)
UNCLEAR = 1e-5  # [m] from the border, where rounding decides


def seen(rng, body, num_envs=1, sensors=1, number=60, dtype=torch.float64):
    """Random poses, and points (B, S, N, 3) half of which are near a shape."""
    T_map_base, T_base_links = any_poses(rng, num_envs), any_poses(rng, num_envs, len(body.links))
    T_map_sensor = T_map_base[:, None] @ any_poses(rng, num_envs, sensors, reach=0.6)
    target = (T_map_base[:, None] @ T_base_links)[..., :3, 3]
    near = target[:, rng.integers(len(body.links), size=(sensors, number))] + torch.from_numpy(
        rng.normal(0, 0.15, (num_envs, sensors, number, 3))
    )
    R, t = T_map_sensor[..., :3, :3], T_map_sensor[..., None, :3, 3]
    return ((near - t) @ R).to(dtype), T_map_sensor, T_map_base, T_base_links


def own_points(body, cloud, T_map_sensor, T_map_base, T_base_links, dtype=torch.float64):
    """(B, S * N) bool: what a map counts as the robot's own."""
    cfg = SensorConfig(min_distance=0.0, exclusion=None, body=body)
    emap = small_map(len(cloud), dtype=dtype, sensor=cfg)
    m = emap.measure(cloud, T_map_sensor, T_map_base, 0.1, T_base_links=T_base_links)
    own = ~m.used & cloud.isfinite().all(-1).flatten(1)
    assert torch.equal(m.used, m.casts) and torch.equal(m.rejected_body, own.sum(1))
    return own


@pytest.mark.slow(1)
@given(SEEDS, st.integers(1, 2), st.integers(1, 3))
def test_agrees_with_the_reference(seed, num_envs, sensors):
    rng = np.random.default_rng(seed)
    body = random_body(rng, padding=rng.uniform(0, 0.03), depth_tolerance=rng.uniform(0, 0.1))
    cloud, T_map_sensor, T_map_base, T_base_links = seen(rng, body, num_envs, sensors, number=6)
    own = own_points(body, cloud, T_map_sensor, T_map_base, T_base_links).view(num_envs, sensors, -1)
    for b, s, n in np.ndindex(own.shape):
        T = T_map_sensor[b, s].numpy()
        p = T[:3, :3] @ cloud[b, s, n].numpy() + T[:3, 3]
        outside = reference.outside_robot(p, T[:3, 3], *as_reference(body, T_map_base[b], T_base_links[b]))
        assert abs(outside) < UNCLEAR or bool(own[b, s, n]) == (outside < 0)


def test_the_cases_hold_both_kinds_of_points():
    rng = np.random.default_rng(0)
    body = random_body(rng, padding=0.01, depth_tolerance=0.05)
    assert 0.2 < own_points(body, *seen(rng, body, 4, number=200)).double().mean() < 0.8


LEG = Capsule(link="leg", start=(0.0, 0.0, 0.0), end=(0.0, 0.0, 1.0), radius=0.05)
BLOCK = Box(link="leg", center=(0.0, 0.0, 0.5), half_lengths=(0.05, 0.05, 0.5))


@pytest.mark.parametrize("shapes", [dict(capsules=(LEG,)), dict(boxes=(BLOCK,))])
def test_by_hand(shapes):
    """A sensor 1 m before an upright leg of 5 cm: its surface is at 0.95 m, and 1.05 m is its back."""
    body = RobotBody(**shapes, padding=0.01, depth_tolerance=0.03)
    expected = {0.90: False, 0.915: True, 0.95: True, 1.0: True, 1.055: True, 1.065: False, 1.1: False}
    for distance, own in expected.items():
        for y, is_beside in ((0.0, False), (0.055, False), (0.07, True)):
            if y == 0.055 and "capsules" in shapes and distance != 1.0:
                continue  # beside the axis a capsule is thinner
            cloud = torch.tensor([[[[distance, y, 0.0]]]], dtype=torch.float64)
            sensor, links = pose((0.0, 0.0, 0.5))[:, None], pose((1.0, 0.0, 0.0))[:, None]
            got = own_points(body, cloud, sensor, pose((0.0, 0.0, 0.0)), links)
            assert got.item() == (own and not is_beside), (distance, y)


def test_ends_of_a_capsule_are_round():
    body = RobotBody(capsules=(LEG,), padding=0.0, depth_tolerance=0.0)
    for angle in np.linspace(0, math.pi, 7):
        for r, own in ((0.049, True), (0.051, False)):
            p = torch.tensor([0.0, r * math.cos(angle), 1.0 + r * math.sin(angle)], dtype=torch.float64)
            sensor, rest = pose((-0.3, -0.3, -0.3))[:, None], pose((0.0, 0.0, 0.0))
            got = own_points(body, p.view(1, 1, 1, 3) + 0.3, sensor, rest, rest[:, None])
            assert got.item() == own


def test_ground_beside_a_standing_foot_stays():
    """A foot of 2 cm stands on the ground: of what a sensor above sees, no more than a rim of its padding is lost."""
    foot = Capsule(link="foot", start=(0.0, 0.0, 0.0), end=(0.0, 0.0, 0.0), radius=0.02)
    body = RobotBody(capsules=(foot,))
    x, y = torch.meshgrid(*[torch.arange(-0.06, 0.06, 0.001, dtype=torch.float64)] * 2, indexing="ij")
    ground = torch.stack([x, y, torch.zeros_like(x)], -1).view(1, 1, -1, 3)
    origin = torch.tensor([-0.3, 0.0, 0.4], dtype=torch.float64)
    own = own_points(
        body, ground - origin, pose((-0.3, 0.0, 0.4))[:, None], pose((0, 0, 0)), pose((0.0, 0.0, 0.02))[:, None]
    )
    # The foot hides a point where the ray passes its middle by less than its radius.
    ray = ground[0, 0] - origin
    offset = torch.tensor([0.0, 0.0, 0.02], dtype=torch.float64) - origin
    hidden = torch.linalg.cross(ray, offset.expand_as(ray)).norm(dim=-1) / ray.norm(dim=-1) < 0.02
    lost = own[0] & ~hidden
    assert lost.double().sum() / (~hidden).double().sum() < 0.005
    ring = math.sqrt((0.02 + body.padding) ** 2 - 0.02**2)  # where the ground enters the padded foot
    assert own[0][ground[0, 0].norm(dim=-1) < ring - 1e-4].all() and lost.any()


@given(SEEDS)
def test_noise_along_the_ray_pushes_no_point_out(seed):
    """Points on the surface that are measured too near by up to the tolerance, or too far by up to the thickness."""
    rng = np.random.default_rng(seed)
    ball = Capsule(link="a", start=(0.0, 0.0, 0.0), end=(0.0, 0.0, 0.0), radius=0.05)
    body = RobotBody(capsules=(ball,), padding=0.005, depth_tolerance=0.03)
    d = rng.normal(size=(200, 3))
    d[:, 0] = 0
    aim = np.array([1.0, 0.0, 0.0]) + 0.0499 * d / np.linalg.norm(d, axis=1, keepdims=True) * rng.random((200, 1))
    ray = aim / np.linalg.norm(aim, axis=1, keepdims=True)
    along = ray[:, 0]
    hit = along - np.sqrt(along**2 - 1 + 0.05**2)
    for error in (-0.0299, 0.0, 0.015):
        cloud = torch.from_numpy(ray * (hit + error)[:, None]).view(1, 1, -1, 3)
        own = own_points(body, cloud, pose((0, 0, 0))[:, None], pose((0, 0, 0)), pose((1.0, 0, 0))[:, None])[0]
        assert own.all(), error


@given(SEEDS)
def test_moving_robot_and_points_together_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    body = random_body(rng)
    cloud, T_map_sensor, T_map_base, T_base_links = seen(rng, body, 2, 2)
    T = any_poses(rng, 1, reach=100.0)
    own = own_points(body, cloud, T_map_sensor, T_map_base, T_base_links)
    again = own_points(body, cloud, T @ T_map_sensor, T[0] @ T_map_base, T_base_links)
    assert (own != again).double().mean() < 0.01  # of which rounding decides


@pytest.mark.slow(1)
@given(SEEDS)
def test_larger_padding_and_tolerance_never_give_a_point_back(seed):
    rng = np.random.default_rng(seed)
    body = random_body(rng, padding=rng.uniform(0, 0.03), depth_tolerance=rng.uniform(0, 0.05))
    case = seen(rng, body, 2)
    own = own_points(body, *case)
    for name in ("padding", "depth_tolerance"):
        larger = dataclasses.replace(body, **{name: getattr(body, name) + rng.uniform(0, 0.05)})
        assert (own_points(larger, *case) | ~own).all()


@pytest.mark.slow(1)
@given(SEEDS)
def test_a_batch_equals_single_maps_bit_for_bit(seed):
    rng = np.random.default_rng(seed)
    body = random_body(rng)
    cloud, *poses = seen(rng, body, 4, 2, dtype=torch.float32)
    own = own_points(body, cloud, *poses, dtype=torch.float32)
    for b in range(4):
        single = own_points(body, *(value[b : b + 1] for value in (cloud, *poses)), dtype=torch.float32)
        assert torch.equal(single[0], own[b])


@given(SEEDS, st.sampled_from([torch.float32, torch.float64]))
def test_precisions_agree(seed, pose_dtype):
    rng = np.random.default_rng(seed)
    body = random_body(rng)
    cloud, *poses = seen(rng, body, 2)
    own = own_points(body, cloud, *poses)
    lower = own_points(body, cloud.float(), *(T.to(pose_dtype) for T in poses), dtype=torch.float32)
    assert (own != lower).double().mean() < 0.02  # of which rounding decides


def test_far_from_the_origin():
    rng = np.random.default_rng(1)
    body = random_body(rng)
    cloud, T_map_sensor, T_map_base, T_base_links = seen(rng, body)
    far = pose((1e5, -1e5, 10.0))
    case = cloud.float(), far @ T_map_sensor, far[0] @ T_map_base, T_base_links
    own = own_points(body, cloud, T_map_sensor, T_map_base, T_base_links)
    assert torch.equal(own_points(body, *case, dtype=torch.float32), own)


def test_a_ray_in_the_plane_of_a_face_spoils_no_other_shape():
    """Where the ray lies in the face and is parallel to it, the place at which it crosses is 0 / 0."""
    block = Box(link="leg", center=(0.0, 0.25, 0.0), half_lengths=(0.25, 0.25, 0.25))
    body = RobotBody(capsules=(LEG,), boxes=(block,), padding=0.0, depth_tolerance=0.0)
    sensor, rest = pose((-1.0, 0.0, 0.0)), pose((0.0, 0.0, 0.0))
    cloud = torch.tensor([[[[1.0, 0.0, 0.0], [1.2, 0.0, 0.0], [2.0, 0.0, 0.0]]]], dtype=torch.float64)
    assert own_points(body, cloud, sensor[:, None], rest, rest[:, None]).tolist() == [[True, True, False]]


def test_only_what_is_in_range_is_on_the_body():
    """A point without a return or out of range counts there, though zeros stand for it at a sensor within a shape."""
    body = RobotBody(capsules=(LEG,))
    emap = small_map(1, sensor=SensorConfig(min_distance=0.1, max_distance=0.2, body=body))
    cloud = torch.tensor([[[torch.nan, 0, 0], [0.05, 0, 0], [1.0, 0, 0], [0.0, 0.0, 0.15]]])
    m = emap.measure(cloud, pose((0, 0, 0.5)), pose((0, 0, 0)), 0.0, T_base_links=pose((0, 0, 0))[:, None])
    assert [m.rejected_invalid.item(), m.rejected_range.item(), m.rejected_body.item()] == [1, 2, 1]


def test_points_have_gradients_and_the_filter_none():
    body = random_body(np.random.default_rng(3))
    cloud, T_map_sensor, T_map_base, T_base_links = seen(np.random.default_rng(3), body)
    cloud.requires_grad_(), T_base_links.requires_grad_()
    emap = small_map(1, dtype=torch.float64, sensor=SensorConfig(min_distance=0.0, exclusion=None, body=body))
    m = emap.measure(cloud, T_map_sensor, T_map_base, 0.1, T_base_links=T_base_links)
    assert 0 < m.used.sum() < m.used.numel()
    emap(emap.state, m).elevation.sum().backward()
    assert cloud.grad.isfinite().all() and T_base_links.grad is None


# Updates --------------------------------------------------------------------------------------------------------------


def update_case(seed=0, num_envs=2):
    """A small map's body, and clouds, sensor poses, base poses and links of an update."""
    rng = np.random.default_rng(seed)
    body = random_body(rng)
    cloud, T_map_sensor, T_map_base, T_base_links = seen(rng, body, num_envs, number=200, dtype=torch.float32)
    return body, torch.cat([cloud[:, 0], torch.rand(num_envs, 100, 3)], 1), T_map_sensor[:, 0], T_map_base, T_base_links


def test_chunks_get_their_own_links():
    body, cloud, T_map_sensor, T_map_base, links = update_case(num_envs=5)
    whole, parts = (ElevationMap(small_config(sensor=SensorConfig(body=body)), 5, chunk=n) for n in (5, 2))
    for emap in (whole, parts):
        emap.update(cloud, T_map_sensor, T_map_base, 0.3, T_base_links=links)
    assert differences(whole.state, parts.state) == [] and (whole.statistics.rejected_body > 0).all()


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, 1e30])
def test_one_bad_link_that_was_not_read_leaves_one_robot_out(bad):
    """As on a GPU, where the host does not wait to read it."""
    body, cloud, T_map_sensor, T_map_base, links = update_case()
    maps = [small_map(2, sensor=SensorConfig(body=body)) for _ in range(2)]
    broken = links.clone()
    broken[1, 0] = bad
    for emap, poses in zip(maps, (links, broken), strict=True):
        emap.update(cloud, T_map_sensor, T_map_base, 0.3, T_base_links=unread(poses))
    assert maps[1].statistics.rejected_invalid.tolist() == [0, 300] and not maps[1].validity[1].any()
    assert torch.equal(maps[0].elevation[0], maps[1].elevation[0]) and maps[1].elevation.isfinite().all()


K4 = (4, 4)
LINKS = pose((0.0, 0.0, 0.0), num_envs=8).view(2, 4, *K4)


@pytest.mark.parametrize("method", ["update", "measure"])
@pytest.mark.parametrize(
    "change, error, text",
    [
        (dict(T_base_links=None), ValueError, r"T_base_links: expected \(2, 4, 4, 4\), .* of a, b, c, d, got None"),
        (dict(T_map_base=None), ValueError, "T_map_base: is required to pose the links of sensor.body"),
        (dict(T_base_links=LINKS[:, :3]), ValueError, r"T_base_links: expected \(2, 4, 4, 4\).*got \(2, 3, 4, 4\)"),
        (dict(T_base_links=LINKS[:1]), ValueError, r"T_base_links: .*got \(1, 4, 4, 4\)"),
        (dict(T_base_links=2 * LINKS), ValueError, r"T_base_links: must be rigid"),
        (dict(T_base_links=LINKS * torch.nan), ValueError, r"T_base_links: must be finite"),
        (dict(T_base_links=LINKS.half()), TypeError, "T_base_links: must be float32, float64"),
        (dict(T_base_links=LINKS.numpy()), TypeError, "T_base_links: must be a torch.Tensor"),
    ],
)
def test_refused_by_name_before_anything_changes(method, change, error, text):
    balls = [Capsule(link=name, start=(0, 0, 0), end=(0, 0, 0), radius=0.1) for name in "abcd"]
    emap = small_map(2, sensor=SensorConfig(body=RobotBody(capsules=tuple(balls))))
    good = dict(T_map_sensor=pose(num_envs=2), T_map_base=pose(num_envs=2), T_base_links=LINKS, dt=0.1)
    emap.update(torch.zeros(2, 9, 3) - 0.5, **good)
    before = snapshot(emap)
    with pytest.raises(error, match=text):
        getattr(emap, method)(torch.zeros(2, 9, 3) - 1, **{**good, **change})
    assert differences(before, snapshot(emap)) == []


@pytest.mark.parametrize("method", ["update", "measure"])
def test_links_without_a_body_that_has_them_are_refused(method):
    emap = mapped()
    before = snapshot(emap)
    with pytest.raises(ValueError, match="T_base_links: must be left out, as sensor.body has no links"):
        getattr(emap, method)(torch.zeros(2, 9, 3), pose(num_envs=2), pose(num_envs=2), 0.1, T_base_links=LINKS)
    assert differences(before, snapshot(emap)) == []
