"""From points to a measurement: transform, gates, noise; depth images and voxels."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from tests.helpers import pose, random_poses, rotation, small_map
from torchelev import BodyConfig, ExclusionConfig, SensorConfig, depth_to_points, voxel_filter
from torchelev.stages.measure.stage import above_ramp

SEEDS = st.integers(0, 10_000)
DTYPES = st.sampled_from([torch.float16, torch.bfloat16, torch.float32, torch.float64])
GATES = dict(min_distance=0.3, max_distance=3.0, exclusion=ExclusionConfig(), body=BodyConfig())
COUNTERS = dict(invalid="rejected_invalid", range="rejected_range", body="rejected_body", overhang="rejected_overhang")


def random_cloud(rng, shape, dtype):
    """Points all around the sensor, some without a return, some on the sensor."""
    cloud = torch.from_numpy(rng.uniform(-2.2, 2.2, (*shape, 3)))
    cloud[torch.from_numpy(rng.random(shape) < 0.1)] = torch.nan
    cloud[torch.from_numpy(rng.random(shape) < 0.05)] = torch.inf
    cloud[torch.from_numpy(rng.random(shape) < 0.05)] = 0.0
    return cloud.to(dtype)


def expected(cfg, cloud, T_map_sensor, T_map_base):
    """The reference's measurement of one environment."""
    return reference.measure(
        cloud.double().numpy(),
        T_map_sensor.numpy(),
        None if T_map_base is None else T_map_base.numpy(),
        noise=(cfg.noise_factor, cfg.noise_floor),
        limits=(cfg.min_distance, cfg.max_distance),
        exclusion=dataclasses.asdict(cfg.exclusion) if cfg.exclusion else None,
        body=dataclasses.asdict(cfg.body) if cfg.body else None,
    )


@given(SEEDS, DTYPES, st.integers(1, 3), st.integers(1, 3), st.booleans(), st.sampled_from([GATES, {}]))
def test_measure_agrees_with_the_reference(seed, dtype, num_envs, sensors, has_base, gates):
    rng = np.random.default_rng(seed)
    cfg = SensorConfig(**gates)
    emap = small_map(num_envs, dtype=torch.float64, sensor=cfg)
    T = torch.stack([random_poses(rng, sensors, 1.0) for _ in range(num_envs)])
    base = random_poses(rng, num_envs) if has_base else None
    cloud = random_cloud(rng, (num_envs, sensors, 40), dtype)
    m = emap.measure(cloud, T, base, 0.1)
    for b in range(num_envs):
        measured = expected(cfg, cloud[b], T[b], None if base is None else base[b])
        gates_passed = [p["gate"] for p in measured]
        assert m.used[b].tolist() == [g == "used" for g in gates_passed]
        assert m.casts[b].tolist() == [g in ("used", "overhang") for g in gates_passed]
        for gate, counter in COUNTERS.items():
            assert getattr(m, counter)[b] == gates_passed.count(gate)
        at_anchor = np.array([*(m.anchor[b].double() * 0.1).tolist(), 0.0])
        for k, p in enumerate(measured):
            if p["gate"] in ("used", "overhang"):
                np.testing.assert_allclose(m.points[b, k].numpy() + at_anchor, p["point"], atol=1e-9)
                assert float(m.variance[b, k]) == pytest.approx(p["variance"])
    if base is None:
        assert m.base is None


@given(SEEDS)
def test_a_float32_map_measures_like_a_float64_map(seed):
    rng = np.random.default_rng(seed)
    T, cloud = random_poses(rng, 2), random_cloud(rng, (2, 50), torch.float32)
    single, double = (small_map(2, dtype=d).measure(cloud, T, T, 0.1) for d in (torch.float32, torch.float64))
    assert torch.equal(single.used, double.used)
    torch.testing.assert_close(single.points.double(), double.points, atol=2e-6, rtol=0)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("value", [1e30, -1e30, 3e38, torch.nan, torch.inf, -torch.inf])
def test_huge_and_infinite_coordinates_are_left_out(axis, value):
    """Huge ones are out of range; none is left to become infinite in a product."""
    cloud = torch.tensor([[[0.1, -0.2, 0.3]]])
    cloud[..., axis] = value
    m = small_map(1).measure(cloud, pose(), None, 0.0)
    assert (m.rejected_range.item(), m.rejected_invalid.item()) == ((1, 0) if abs(value) < torch.inf else (0, 1))
    assert not m.used.any() and m.points.isfinite().all() and m.variance.isfinite().all()


def test_huge_coordinates_together_are_out_of_range():
    m = small_map(1).measure(torch.tensor([[[-1e38, 1e38, 1e38]]]), pose(), None, 0.0)
    assert m.rejected_range.item() == 1 and not m.used.any() and m.points.isfinite().all()


def test_variances_of_the_user_replace_the_model():
    emap = small_map(1)
    cloud = torch.tensor([[[0.0, 0.1, -1.0], [0.1, 0.0, -1.0], [0.1, 0.1, -1.0]]])
    m = emap.measure(cloud, pose(), None, 0.0, variance=torch.tensor([[0.5, 0.2, 1e-6]]))
    assert torch.equal(m.variance, torch.tensor([[0.5, 0.2, 1e-6]])) and m.used.all()


@pytest.mark.parametrize("variance", [torch.nan, torch.inf, -torch.inf, -1.0, 0.0, 1e-39])
def test_points_without_a_variance_are_ignored(variance):
    """1e-39 has no inverse that float32 holds."""
    cloud = torch.tensor([[[0.0, 0.1, -1.0], [0.1, 0.0, -1.0]]])
    m = small_map(1).measure(cloud, pose(), None, 0.0, variance=torch.tensor([[0.5, variance]]))
    assert m.used.tolist() == m.casts.tolist() == [[True, False]] and m.rejected_invalid.item() == 1
    assert m.variance[0, 0] == 0.5 and (m.variance > 0).all()  # nonsense does not poison the map


def test_a_variance_orders_the_weight_of_points():
    emap = small_map(1, (1, 1), 1.0)
    cloud = torch.tensor([[[0.0, 0.1, -1.0], [0.1, 0.0, -0.9]]])
    emap.update(cloud, pose(), dt=0.0, variance=torch.tensor([[0.01, 0.03]]))
    assert emap.layer("elevation").item() == pytest.approx(0.025, abs=1e-6)  # (3 * 0 + 1 * 0.1) / 4


@given(SEEDS)
def test_ramp_agrees_with_the_reference(seed):
    rng = np.random.default_rng(seed)
    ramp = ExclusionConfig(slope=rng.uniform(0, 1), distance=rng.uniform(0, 2), offset=0.2, height=rng.uniform(0.2, 1))
    relative = rng.uniform(-2, 2, (1, 50, 3))
    got = above_ramp(torch.from_numpy(relative), ramp)[0].tolist()
    assert got == [reference.above_ramp(*p, **dataclasses.asdict(ramp)) for p in relative[0]]


def test_the_ramp_stands_upright_when_the_sensor_pitches():
    """The exclusion area belongs to the map's axes: a pitched camera does not tilt it."""
    emap = small_map(1)
    T = pose((0, 0, 1.0), pitch=0.6)
    for height, excluded in ((1.15, False), (1.25, True)):
        in_map = torch.tensor([[0.5, 0.0, height]], dtype=torch.float64)
        cloud = (in_map - T[0, :3, 3]) @ T[0, :3, :3]
        assert emap.measure(cloud[None], T, None, 0.0).rejected_overhang.item() == int(excluded)


def test_the_body_box_turns_with_the_base():
    emap = small_map(1, sensor=SensorConfig(body=BodyConfig(lower=(0.0, -0.1, -2), upper=(0.5, 0.1, 2))))
    cloud = torch.tensor([[[0.0, 0.4, -1.0], [0.4, 0.0, -1.0]]])
    assert emap.measure(cloud, pose(), pose(yaw=np.pi / 2), 0.0).used.tolist() == [[False, True]]
    assert emap.measure(cloud, pose(), pose(), 0.0).used.tolist() == [[True, False]]
    assert emap.measure(cloud, pose(), None, 0.0).used.tolist() == [[True, True]]


@pytest.mark.parametrize("along", ["z", "ray"])
@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_depth_to_points_agrees_with_the_reference(along, batch):
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.3, 4, (*batch, 5, 7))
    depth[rng.random(depth.shape) < 0.2] = 0.0
    depth[rng.random(depth.shape) < 0.1] = np.nan
    K = np.array([[4.0, 0, 3.2], [0, 5.0, 2.1], [0, 0, 1]])
    points = depth_to_points(torch.from_numpy(depth), torch.from_numpy(K), along)
    assert points.shape == (*batch, 35, 3)
    for index in np.ndindex(*batch):
        expected = reference.depth_to_points(depth[index], 4.0, 5.0, 3.2, 2.1, along)
        np.testing.assert_allclose(points[index], expected, rtol=1e-12)


def test_depth_to_points_takes_intrinsics_for_each_image():
    depth = torch.full((2, 3, 3), 2.0)
    K = torch.eye(3).repeat(2, 1, 1)
    K[1, 0, 0] = 2.0
    points = depth_to_points(depth, K)
    torch.testing.assert_close(points[1, :, 0], points[0, :, 0] / 2)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.uint16, torch.int32, torch.uint32, torch.int64])
def test_integer_depth_takes_a_scale(dtype):
    units = torch.tensor([[[0, 1, 90], [100, 120, 127]]], dtype=dtype)
    K = torch.tensor([[2.5, 0, 1.2], [0, 2.5, 0.4], [0, 0, 1]], dtype=torch.float64)
    points = depth_to_points(units, K, scale=0.01)
    assert points.dtype == torch.float32
    metres = units.to(torch.float64) * 0.01
    torch.testing.assert_close(points.double(), depth_to_points(metres, K), equal_nan=True, atol=1e-6, rtol=0)
    with pytest.raises(ValueError, match=r"scale: is required for integer depth, got None; .*0\.001"):
        depth_to_points(units, K)


def test_a_scale_of_floats_counts():
    depth = torch.tensor([[1500.0, 2000.0]])
    metres = depth_to_points(depth / 1000, torch.eye(3))
    torch.testing.assert_close(depth_to_points(depth, torch.eye(3), scale=0.001), metres)


@pytest.mark.parametrize("along", ["z", "ray"])
def test_opengl_cameras_look_along_minus_z(along):
    """A camera that looks straight down has no rotation in OpenGL's axes, and half a turn about x in optical ones."""
    depth, K = torch.rand(2, 3, 4, dtype=torch.float64) + 0.5, torch.eye(3, dtype=torch.float64)
    K[0, 2] = 1.3
    optical, opengl = (depth_to_points(depth, K, along, frame=frame) for frame in ("optical", "opengl"))
    torch.testing.assert_close(opengl, optical * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    emap = small_map(2, dtype=torch.float64)
    m = emap.measure(opengl, pose(num_envs=2), None, dt=0.0)
    turned = emap.measure(optical, pose(roll=np.pi, num_envs=2), None, dt=0.0)
    torch.testing.assert_close(m.points, turned.points)
    assert (m.points[..., 2] < 1).all() and m.casts.all()


@pytest.mark.parametrize(
    "arguments, options, message",
    [
        ((torch.ones(4, 4), torch.eye(3), "x"), {}, "along"),
        ((torch.ones(4), torch.eye(3)), {}, "depth"),
        ((torch.ones(2, 4, 5, 1), torch.eye(3)), {}, r"depth: expected .*, got \(2, 4, 5, 1\); .*squeeze"),
        ((torch.ones(4, 5, 1), torch.eye(3)), {}, "depth: expected"),
        ((torch.ones(4, 4), torch.eye(4)), {}, "intrinsics"),
        ((torch.ones(2, 1, 4, 5), torch.eye(3).repeat(2, 1, 1)), {}, r"intrinsics: expected .*\(2, 1, 3, 3\)"),
        ((torch.ones(2, 4, 5), torch.eye(3).repeat(3, 1, 1)), {}, "intrinsics"),
        ((torch.ones(4, 5), torch.eye(3)[None]), {}, "intrinsics"),
        ((torch.ones(4, 5), torch.zeros(3, 3)), {}, "intrinsics: must have positive, finite focal lengths, got"),
        ((torch.ones(2, 4, 5), torch.stack([torch.eye(3), -torch.eye(3)])), {}, "intrinsics: must have positive"),
        ((torch.ones(4, 4), torch.eye(3)), dict(frame="gl"), "frame"),
        ((torch.ones(4, 4), torch.eye(3)), dict(scale=0.0), "scale"),
        ((torch.ones(4, 4), torch.eye(3)), dict(scale=torch.nan), "scale"),
    ],
)
def test_depth_to_points_refuses(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        depth_to_points(*arguments, **options)


def test_depth_to_points_refuses_masks():
    with pytest.raises(TypeError, match="depth: must be floats or integers"):
        depth_to_points(torch.ones(4, 4, dtype=torch.bool), torch.eye(3), scale=1.0)


def test_depth_to_points_refuses_arrays():
    depth, intrinsics = torch.ones(4, 4), torch.eye(3)
    for images, matrix, name in ((depth.numpy(), intrinsics, "depth"), (depth, intrinsics.numpy(), "intrinsics")):
        with pytest.raises(TypeError, match=f"{name}: must be a torch.Tensor, got ndarray; make it one"):
            depth_to_points(images, matrix)


@given(SEEDS, st.sampled_from([torch.float32, torch.float64]), st.floats(0.2, 2.0))
def test_voxel_filter_agrees_with_the_reference(seed, dtype, size):
    rng = np.random.default_rng(seed)
    cloud = random_cloud(rng, (2, 60), dtype)
    filtered = voxel_filter(cloud, size)
    assert filtered.shape == cloud.shape
    for b in range(2):
        means = reference.voxel_means(cloud[b].double().numpy(), size)
        kept = filtered[b][filtered[b].isfinite().all(-1)].double().numpy()
        assert len(kept) == len(means) and filtered[b, len(means) :].isnan().all()
        nearest = [np.abs(kept - mean).max(1).min() for mean in means.values()]
        assert max(nearest) < 1e-5


@given(SEEDS, st.integers(1, 80))
def test_voxel_filter_keeps_the_nearest_voxels(seed, max_points):
    cloud = random_cloud(np.random.default_rng(seed), (2, 60), torch.float64)
    filtered = voxel_filter(cloud, 0.7, max_points)
    assert filtered.shape == (2, max_points, 3)
    for b in range(2):
        means = sorted(reference.voxel_means(cloud[b].numpy(), 0.7).values(), key=np.linalg.norm)[:max_points]
        np.testing.assert_allclose(filtered[b, : len(means)], means, atol=1e-9)
        assert filtered[b, len(means) :].isnan().all()


def test_voxel_filter_favours_no_side():
    """Of a ring of points around the sensor, those left are as many ahead as behind."""
    angle = torch.arange(400) * (2 * torch.pi / 400) + 0.001
    r = torch.linspace(1, 4, 20)[:, None]
    cloud = torch.stack([r * angle.cos(), r * angle.sin(), torch.full_like(r * angle, -0.5)], -1).view(1, -1, 3)
    kept = voxel_filter(cloud, 0.1, 1000)[0]
    assert kept.isfinite().all() and abs((kept[:, 0] > 0).double().mean() - 0.5) < 0.02
    assert kept.norm(dim=-1).diff().min() > -1e-6


def test_voxel_filter_in_half_precision_tells_far_from_near():
    """Squares of 300 m do not fit float16."""
    cloud = torch.tensor([[[400.0, 0, 0], [300.0, 0, 0]]], dtype=torch.float16)
    assert voxel_filter(cloud, 1.0, 1)[0, 0, 0] == 300


def test_voxel_filter_pads_or_drops_to_max_points():
    cloud = torch.tensor([[[9.0, 0, 0], [-5.0, 0, 0], [0.0, 0, 0]]])
    assert voxel_filter(cloud, 1.0, 2)[0, :, 0].tolist() == [0, -5]
    assert voxel_filter(cloud, 1.0, 5)[0, :, 0].isnan().tolist() == [False, False, False, True, True]


@pytest.mark.parametrize(
    "arguments, error, named",
    [
        ((torch.ones(1, 2, 3), 0.0), ValueError, "size"),
        ((torch.ones(1, 2, 3), 1.0, 0), ValueError, "max_points"),
        ((torch.ones(1, 2, 3), 1.0, 2.5), ValueError, "max_points"),
        ((torch.ones(2, 3), 1.0), ValueError, "points"),
        ((torch.ones(1, 2, 3, dtype=torch.int32), 1.0), TypeError, "points"),
    ],
)
def test_voxel_filter_refuses(arguments, error, named):
    with pytest.raises(error, match=named):
        voxel_filter(*arguments)


def test_gradient_of_voxel_filter():
    cloud = torch.rand(1, 12, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: voxel_filter(p, 0.6, 4), (cloud,))


def test_an_off_axis_sensor_pose():
    """Points turn with the full rotation: roll, pitch and yaw at once."""
    emap = small_map(1, dtype=torch.float64, sensor=SensorConfig(exclusion=None))
    R = rotation(0.3, -0.4, 1.2)
    m = emap.measure(torch.tensor([[[1.0, 2.0, 3.0]]]), pose((0.2, 0.3, 0.4), 0.3, -0.4, 1.2), None, 0.0)
    point = m.points[0, 0].numpy() + [*(m.anchor[0].double() * 0.1).tolist(), 0]
    np.testing.assert_allclose(point, R @ [1, 2, 3] + [0.2, 0.3, 0.4], atol=1e-12)


@pytest.mark.parametrize(
    "bad, named",
    [
        (dict(noise_factor=-1.0), "noise_factor"),
        (dict(noise_floor=0.0), "noise_floor"),
        (dict(min_distance=5.0, max_distance=1.0), "min_distance"),
    ],
)
def test_refuses(bad, named):
    with pytest.raises(ValueError, match=f"sensor.{named}"):
        SensorConfig(**bad)
