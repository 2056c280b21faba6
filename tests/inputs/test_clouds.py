"""Halves: points and depth are computed in float32 and rounded once, so that sums do not overflow."""

import pytest
import torch

from torchelev import depth_to_points, voxel_filter

HALVES = pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
K = torch.tensor([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])


@HALVES
def test_a_dense_voxel_of_halves_keeps_its_mean(dtype):
    """4,000 points at x = 30 m sum to 120,000, beyond what float16 holds."""
    points = torch.tensor([30.0, 20.0, 1.0], dtype=dtype).repeat(1, 4000, 1)
    means = voxel_filter(points, 0.5)
    assert means.dtype == dtype and means[0, 0].tolist() == [30.0, 20.0, 1.0]
    assert means[0, 1:].isnan().all()


@HALVES
@pytest.mark.parametrize("along", ["z", "ray"])
@pytest.mark.parametrize("scale", [None, 0.001])
def test_depth_of_halves_has_the_rays_of_float32(dtype, along, scale):
    depth = (torch.linspace(1, 4, 480 * 640).view(480, 640) / (scale or 1.0)).to(dtype)
    points = depth_to_points(depth, K, along, scale=scale)
    exact = depth_to_points(depth.double(), K.double(), along, scale=scale)
    assert points.dtype == dtype
    torch.testing.assert_close(points.double(), exact, rtol=torch.finfo(dtype).eps, atol=1e-6)
