"""Poses between poses, and the motion within a scan."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests import reference
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.frames import deskew, interpolate_poses
from torchelev.sim import Box, Lidar, Scene
from torchelev.sim.poses import pose

SEEDS = st.integers(0, 10_000)


def trajectory(rng, num_envs, num_poses, far=0.0):
    """Poses (B, K, 4, 4) of a bent way with stamps (B, K), float64."""
    T = np.tile(np.eye(4), (num_envs, num_poses, 1, 1))
    for b in range(num_envs):
        steps = Rotation.from_rotvec(rng.normal(size=(num_poses, 3)) * 0.4)
        R = Rotation.random(random_state=rng.integers(1 << 30))
        for k in range(num_poses):
            R = R * steps[k]
            T[b, k, :3, :3] = R.as_matrix()
        T[b, :, :3, 3] = far + np.cumsum(rng.normal(size=(num_poses, 3)), 0)
    stamps = 1e9 + np.cumsum(rng.uniform(0.02, 0.2, (num_envs, num_poses)), 1)
    return torch.from_numpy(T), torch.from_numpy(stamps)


@given(SEEDS, st.integers(1, 3), st.integers(2, 5), st.booleans())
def test_agrees_with_the_reference(seed, num_envs, num_poses, is_double):
    rng = np.random.default_rng(seed)
    poses, stamps = trajectory(rng, num_envs, num_poses, far=1e5)
    points = torch.from_numpy(rng.normal(size=(num_envs, 9, 3)))
    times = stamps[:, :1] + (stamps[:, -1:] - stamps[:, :1]) * torch.from_numpy(rng.uniform(-0.02, 1.02, (num_envs, 9)))
    at = stamps.mean(1)
    moved = deskew(points if is_double else points.float(), times, poses, stamps, at)
    assert moved.dtype == (torch.float64 if is_double else torch.float32)
    for b in range(num_envs):
        expected = reference.deskew(*(x[b].numpy() for x in (points, times, poses, stamps)), float(at[b]))
        np.testing.assert_allclose(moved[b].numpy(), expected, atol=1e-5)
        T = interpolate_poses(poses, stamps, times)[b, 3].numpy()
        np.testing.assert_allclose(
            T, reference.pose_at(float(times[b, 3]), stamps[b].numpy(), poses[b].numpy()), atol=1e-6
        )


@given(SEEDS)
def test_a_batch_equals_single_clouds(seed):
    rng = np.random.default_rng(seed)
    poses, stamps = trajectory(rng, 3, 4)
    points = torch.from_numpy(rng.normal(size=(3, 5, 3)))
    times = stamps[:, :1] + 0.05 * torch.rand(3, 5, dtype=torch.float64)
    batch = deskew(points, times, poses, stamps, stamps[:, 1])
    for b in range(3):
        single = deskew(points[b, None], times[b, None], poses[b, None], stamps[b, None], stamps[b, None, 1])
        torch.testing.assert_close(single[0], batch[b], atol=1e-12, rtol=0)


def test_points_at_the_instant_stay():
    poses, stamps = trajectory(np.random.default_rng(0), 1, 3)
    points = torch.rand(1, 4, 3, dtype=torch.float64)
    moved = deskew(points, stamps[:, 1:2].expand(1, 4), poses, stamps, stamps[:, 1])
    torch.testing.assert_close(moved, points)


def test_a_still_sensor_changes_nothing_and_has_gradients():
    poses = torch.eye(4, dtype=torch.float64).expand(1, 2, 4, 4).clone().requires_grad_()
    stamps, times = torch.tensor([[0.0, 0.1]]).double(), torch.full((1, 3), 0.05).double().requires_grad_()
    points = torch.rand(1, 3, 3, dtype=torch.float64).requires_grad_()
    moved = deskew(points, times, poses, stamps, torch.tensor([0.1]).double())
    torch.testing.assert_close(moved, points)
    moved.square().sum().backward()
    assert all(torch.isfinite(x.grad).all() for x in (points, times, poses)) and points.grad.abs().min() > 0


def test_gradients_agree_with_differences():
    rng = np.random.default_rng(1)
    poses, stamps = trajectory(rng, 1, 3)
    stamps = stamps - 1e9
    points = torch.from_numpy(rng.normal(size=(1, 2, 3))).requires_grad_()
    times = (stamps[:, :1] + torch.tensor([[0.01, 0.03]])).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, t: deskew(p, t, poses, stamps, stamps[:, 1]), (points, times))


@pytest.mark.parametrize("time", [-0.11, 0.31, torch.nan, torch.inf])
def test_times_too_far_outside_give_nan(time):
    poses, stamps = trajectory(np.random.default_rng(0), 1, 2)
    stamps = torch.tensor([[0.0, 0.2]]).double()
    times = torch.tensor([[0.1, time]]).double()
    moved = deskew(torch.zeros(1, 2, 3), times, poses, stamps, torch.tensor([0.1]).double())
    assert torch.isfinite(moved[0, 0]).all() and moved[0, 1].isnan().all()


def test_the_host_does_not_wait():
    from torch._subclasses.fake_tensor import FakeTensorMode

    with FakeTensorMode():
        poses, stamps = torch.eye(4).expand(2, 3, 4, 4), torch.zeros(2, 3)
        assert deskew(torch.zeros(2, 5, 3), torch.zeros(2, 5), poses, stamps, torch.zeros(2)).shape == (2, 5, 3)


GOOD = dict(
    points=torch.zeros(1, 4, 3), times=torch.zeros(1, 4), poses=torch.eye(4).expand(1, 2, 4, 4),
    stamps=torch.tensor([[0.0, 1.0]]), at=torch.zeros(1),
)  # fmt: skip
BAD = {
    "points": (torch.zeros(1, 4), r"expected \(B, N, 3\)"),
    "times": (torch.zeros(1, 3), r"expected \(1, 4\)"),
    "poses": (torch.eye(4).expand(1, 1, 4, 4), "must be at least two, got 1"),
    "stamps": (torch.tensor([[1.0, 1.0]]), "must increase"),
    "at": (torch.zeros(2), r"expected \(1,\)"),
    "max_extrapolation": (-1.0, "must be finite and not negative"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_arguments_are_refused_by_name(name):
    value, words = BAD[name]
    with pytest.raises(ValueError, match=f"{name}: {words}"):
        deskew(**(GOOD | {name: value}))


def step_up(k):
    """The k-th step: 12 cm up, 30 cm farther."""
    return Box(low=(0.8 + 0.3 * k, -3.0, -1.0), high=(9.0, 3.0, 0.12 * (k + 1)), grounded=True)


STAIRS = Scene(boxes=tuple(step_up(k) for k in range(4)))


def spin(lidar, start, end, parts=36):
    """A scan that is taken while the sensor moves: points (N, 3) and their times, 0 to 1."""
    stamps, poses = torch.tensor([[0.0, 1.0]]).double(), torch.stack([start, end])[None]
    azimuth = torch.atan2(lidar.directions[:, 1], lidar.directions[:, 0]) / (2 * np.pi) + 0.5
    points, times = torch.full_like(lidar.directions, torch.nan), (azimuth * parts).floor().clamp(max=parts - 1) / parts
    for k in range(parts):
        T = interpolate_poses(poses, stamps, torch.tensor([[k / parts]]).double())[0, 0]
        now = times == k / parts
        points[now] = lidar.cast(STAIRS, T)[now].to(points.dtype)
    return points, times.double()


def rmse(points, T):
    emap = ElevationMap(ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=4.0, length_y=4.0)))
    for _ in range(3):
        emap.update(points[None].float(), T[None], None, dt=0.1)
    error = emap.layer("elevation")[0] - STAIRS.truth(emap.cell_centers()[0], 0.0)
    return float(error[error.isfinite()].square().mean().sqrt())


@pytest.mark.slow(1)
def test_a_moving_lidar_over_stairs_maps_like_a_still_one():
    """By 2 degrees and 10 cm within a scan."""
    lidar = Lidar(azimuths=720)
    start = pose(torch.tensor([0.0, 0.1, 0.8], dtype=torch.float64), 0.0, 0.0)
    end = pose(torch.tensor([0.1, 0.1, 0.8], dtype=torch.float64), np.deg2rad(2.0), 0.0)
    points, times = spin(lidar, start, end)
    stamps, poses = torch.tensor([[0.0, 1.0]]).double(), torch.stack([start, end])[None]
    moved = deskew(points[None], times[None], poses, stamps, torch.ones(1).double())[0]
    still, skewed, corrected = rmse(spin(lidar, end, end)[0], end), rmse(points, end), rmse(moved, end)
    assert corrected <= 1.2 * still < skewed


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_points_of_halves_are_moved_in_float32(dtype):
    """A turn by half a radian at 20 m: in bfloat16 its matrix alone would be off by centimetres."""
    poses = torch.eye(4, dtype=torch.float64).repeat(1, 2, 1, 1)
    poses[0, 1, :3, :3] = torch.from_numpy(Rotation.from_euler("z", 0.5).as_matrix())
    stamps, at = torch.tensor([[0.0, 1.0]]).double(), torch.zeros(1).double()
    points = 20 * torch.rand(1, 500, 3, generator=torch.Generator().manual_seed(0)).to(dtype)
    times = torch.linspace(0, 1, 500).double()[None]
    exact = deskew(points.double(), times, poses, stamps, at)
    moved = deskew(points, times, poses, stamps, at)
    assert moved.dtype == dtype
    torch.testing.assert_close(moved.double(), exact, rtol=torch.finfo(dtype).eps, atol=1e-5)
