"""Halves: points and depth are computed in float32 and rounded once, so that sums do not overflow."""

import math

import pytest
import torch

from torchelev import depth_to_points, voxel_filter
from torchelev.inputs.clouds import height_map_to_points

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


def test_a_height_map_becomes_points():
    heights = torch.tensor([[0.1, 1e9, 0.3], [math.nan, 0.5, math.inf]])
    points = height_map_to_points(heights, 0.5, (-1.0, 2.0))
    known = points.isfinite().all(-1)
    assert known.tolist() == [True, False, True, False, True, False]
    torch.testing.assert_close(points[known], torch.tensor([[-1.0, 2.0, 0.1], [0.0, 2.0, 0.3], [-0.5, 2.5, 0.5]]))
    assert height_map_to_points(heights.expand(4, 2, 3), 0.5, (0.0, 0.0)).shape == (4, 6, 3)


@pytest.mark.parametrize(
    "heights, resolution, error, words",
    [
        (torch.zeros(3), 0.1, ValueError, "heights: expected"),
        (torch.zeros(3, 3), 0.0, ValueError, "resolution: must be a positive number"),
        (torch.zeros(3, 3, dtype=torch.int64), 0.1, TypeError, "heights: must be a tensor of floats"),
    ],
)
def test_bad_height_maps_are_refused(heights, resolution, error, words):
    with pytest.raises(error, match=words):
        height_map_to_points(heights, resolution, (0.0, 0.0))
