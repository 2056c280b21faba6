"""Wrong ranges have the statistics that their config says, and lie on their rays.

Bounds on statistics are five standard errors of the sample.
"""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.sim.errors.error_cases import NAN, assert_mean, assert_share, make, rays
from torchelev.sim.errors.range_errors import find_range_across_edge


@pytest.mark.parametrize(("field", "low", "high"), [("too_short", 0.1, 1.0), ("too_long", 1.05, 2.0)])
def test_artefacts_lie_on_their_ray_at_wrong_ranges(field, low, high):
    points = rays(1, 40_000)
    got = make(**{field: 0.2})(points).points
    ratio = got.norm(dim=-1) / points.norm(dim=-1)
    wrong = (ratio - 1).abs() > 1e-6
    assert_share(wrong, 0.2)
    assert float(ratio[wrong].min()) >= low - 1e-6 and float(ratio[wrong].max()) <= high + 1e-6
    assert_mean(ratio[wrong], (low + high) / 2, (high - low) / math.sqrt(12))


def test_artefacts_of_both_kinds_share_the_cloud():
    points = rays(1, 40_000)
    ratio = make(too_short=0.3, too_long=0.7)(points).points.norm(dim=-1) / points.norm(dim=-1)
    for wrong, share, low, high in ((ratio < 1.0, 0.3, 0.1, 1.0), (ratio > 1.04, 0.7, 1.05, 2.0)):
        assert_share(wrong, share)
        assert low - 1e-6 <= float(ratio[wrong].min()) and float(ratio[wrong].max()) <= high + 1e-6
        assert_mean(ratio[wrong], (low + high) / 2, (high - low) / math.sqrt(12))


def two_sides(B=200, h=12, w=10, near=1.0, far=3.0):
    """Clouds that are images: columns 0 to 3 near, the others far, along one ray each."""
    d = torch.full((B, h, w), far)
    d[..., :4] = near
    return rays(B, h * w, 1.0) * d.view(B, h * w, 1), d


def test_flying_pixels_lie_between_the_two_sides_of_an_edge():
    points, d = two_sides()
    got = make(200, flying=0.4)(points, image_shape=(12, 10)).points.norm(dim=-1).view_as(d)
    moved = (got - d).abs() > 1e-5
    assert not moved[..., :3].any() and not moved[..., 5:].any()
    for side in (3, 4):  # the last near column, the first far one
        assert_share(moved[..., side], 0.4)
        between = got[..., side][moved[..., side]]
        assert float(between.min()) >= 1.0 - 1e-6 and float(between.max()) <= 3.0 + 1e-6
        assert_mean(between, 2.0, 2 / math.sqrt(12))


def test_flying_pixels_need_a_step_and_two_returns():
    points, d = two_sides(near=2.92)
    got = make(200, flying=1.0)(points, image_shape=(12, 10)).points  # 8 cm is below flying_step
    torch.testing.assert_close(got, points)
    points, d = two_sides()
    points[d.flatten(1) == 3.0] = NAN
    got = make(200, flying=1.0)(points, image_shape=(12, 10)).points
    torch.testing.assert_close(got, points, equal_nan=True)


def test_without_an_image_the_neighbours_are_those_in_the_order():
    d = torch.tensor([[1.0, 1.0, 3.0, 3.0, 3.1]])
    assert find_range_across_edge(d, (1, 5)).tolist() == [[1.0, 3.0, 1.0, pytest.approx(3.1), 3.0]]


@given(seed=st.integers(0, 10_000), h=st.integers(1, 4), w=st.integers(1, 5))
def test_the_neighbour_across_an_edge_is_the_one_that_differs_most(seed, h, w):
    rng = np.random.default_rng(seed)
    image = rng.uniform(1, 5, (h, w))
    image[rng.uniform(size=(h, w)) < 0.2] = np.nan
    got = find_range_across_edge(torch.from_numpy(image).view(1, -1), (h, w)).view(h, w).numpy()
    for i in range(h):
        for j in range(w):
            around = ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1))
            beside = [image[a, b] for a, b in around if 0 <= a < h and 0 <= b < w]
            most = np.nanmax([0.0, *(abs(v - image[i, j]) for v in beside)])
            if np.isnan(image[i, j]):
                assert np.isnan(got[i, j])
            else:
                assert abs(got[i, j] - image[i, j]) == most


def test_ranges_come_in_steps():
    points = rays(2, 1000)
    got = make(2, range_step=0.05)(points).points.norm(dim=-1)
    torch.testing.assert_close(got / 0.05, (got / 0.05).round(), atol=1e-3, rtol=0)
    assert float((got - points.norm(dim=-1)).abs().max()) <= 0.025 + 1e-5


def test_disparities_come_in_steps():
    points = rays(2, 5000)
    got = make(2, disparity_step=0.02)(points).points
    seen = points[..., 0] > 0.05
    steps = 1 / got[seen][:, 0] / 0.02
    torch.testing.assert_close(steps, steps.round(), atol=0.01, rtol=1e-4)
    # Half a step of 0.02 / m at x = 2 m is 0.01 * 2^2 = 4 cm.
    near_two = (points[..., 0] - 2).abs() < 0.2
    worst = float((got - points)[near_two][:, 0].abs().max())
    assert 0.03 < worst < 0.05
    assert bool(got[points[..., 0] <= 0].isnan().all())  # behind the camera
    assert float(torch.linalg.cross(got[seen], points[seen]).norm(dim=-1).max()) < 1e-4


def test_disparity_by_hand():
    # 1 / 1.9 = 0.5263 = 5.26 steps of 0.1, so 5: x = 2, and y grows by 2 / 1.9. 1 / 25 is rounded to no disparity.
    points = torch.tensor([[[1.9, 0.95, 0.0], [25.0, 0.0, 0.0]]])
    got = make(disparity_step=0.1)(points).points
    torch.testing.assert_close(got, torch.tensor([[[2.0, 1.0, 0.0], [NAN, NAN, NAN]]]), equal_nan=True)
