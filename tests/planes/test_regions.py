"""What planners and controllers ask of regions: convex polygons and footholds."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchelev.planes import PlaneConfig, convex_region, segment
from torchelev.planes.polygons import nearest_points, ray_crosses
from torchelev.sim.exact.plane_scenes import RISE, RUN, mixed, noisy, stairs

pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def rings():
    return segment(noisy(mixed(0.04)), 0.04)[0]


def is_inside(border, xy):
    return ray_crosses(border, np.asarray(xy, float)).sum() % 2 == 1


def block(cells=slice(5, 15), **cfg):
    """One region, 10 x 10 cells of 0.1 m around the origin, level at 0.5 m."""
    z = torch.full((20, 20), torch.nan)
    z[cells, 5:15] = 0.5
    (planes,) = segment(z, 0.1, PlaneConfig(**cfg))
    return planes


def test_nearest_foothold_by_hand():
    planes = block(margin=0.1)  # the inset reaches from -0.4 to 0.4
    for query, point in (((0.1, -0.2), (0.1, -0.2)), ((3, 0.1), (0.4, 0.1)), ((-1, -7), (-0.4, -0.4))):
        foothold = planes.nearest_foothold(query)
        np.testing.assert_allclose(foothold.point, (*point, 0.5), atol=1e-9)
        np.testing.assert_allclose(foothold.distance, np.hypot(*np.subtract(query, point)), atol=1e-9)
        assert foothold.region is planes.regions[0]
    assert planes.nearest_foothold(torch.tensor([0.1, 0.2])).distance == 0


def test_no_foothold_where_nothing_is_left():
    assert segment(torch.full((5, 5), torch.nan), 0.1)[0].nearest_foothold((0, 0)) is None
    assert block(margin=0.6).nearest_foothold((0, 0)) is None


@given(st.floats(-6, 6), st.floats(-6, 6))
def test_no_foothold_is_nearer(rings, x, y):
    """Against every corner of every inset, and in the inset itself or on its border."""
    foothold = rings.nearest_foothold((x, y))
    insets = [p for region in rings.regions for p in (*region.inset, *region.inset_holes)]
    assert foothold.distance <= np.hypot(*(np.concatenate(insets)[:, :2] - (x, y)).T).min() + 1e-12
    region, xy = foothold.region, foothold.point[:2]
    to_inset = np.hypot(*(nearest_points(region.inset_border, xy) - xy).T).min()
    assert is_inside(region.inset_border, xy) or to_inset < 1e-9
    assert abs((foothold.point - region.point) @ region.normal) < 1e-9
    to_border = np.hypot(*(nearest_points(region.border, xy) - xy).T).min()
    assert is_inside(region.border, xy) and to_border > 0.03 - 1e-4


def test_footholds_avoid_the_grown_hole(rings):
    """From the middle of the ring's hole the floor inside is nearest; without it, the ring a margin from its hole."""
    inside = rings.nearest_foothold((2.0, -2.5))
    assert inside.distance == 0 and abs(inside.point[2]) < 0.01
    ring = next(r for r in rings.regions if abs(r.point[2] - 0.25) < 0.01)
    xy = ring.point[:2] + (0.61, 0)
    assert is_inside(ring.border, xy) and not is_inside(ring.inset_border, xy)


def test_stairs_give_the_height_of_the_tread():
    (planes,) = segment(noisy(stairs(0.02)), 0.02)
    for k in (1, 4, 9):
        foothold = planes.nearest_foothold((-2 + (k - 0.5) * RUN, 0.3))
        assert foothold.distance == 0 and abs(foothold.point[2] - k * RISE) < 0.005


@pytest.mark.parametrize("margin", [0.0, 0.15])
def test_convex_region_of_a_square_is_the_square(margin):
    polygon = convex_region(block().regions[0], (0.2, -0.1), margin)
    assert polygon.shape == (4, 3) and (polygon[:, 2] == 0.5).all()
    np.testing.assert_allclose(np.abs(polygon[:, :2]), 0.5 - margin, atol=1e-9)


@given(st.integers(0, 10_000))
def test_convex_regions_lie_inside_around_the_foothold(rings, seed):
    rng = np.random.default_rng(seed)
    foothold = rings.nearest_foothold(rng.uniform(-6, 6, 2))
    xy, region = foothold.point[:2], foothold.region
    polygon = convex_region(region, xy)
    assert np.abs((polygon - region.point) @ region.normal).max() < 1e-9
    p = polygon[:, :2]
    a, b = np.roll(p, -1, 0) - p, np.roll(p, -2, 0) - np.roll(p, -1, 0)
    assert (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > -1e-9).all()
    towards = xy - p
    assert (a[:, 0] * towards[:, 1] - a[:, 1] * towards[:, 0] > 0).all()
    for _ in range(30):  # random points of the polygon, a little towards the foothold
        share = rng.dirichlet(np.ones(len(p)))
        assert is_inside(region.border, xy + 0.999 * (share @ p - xy))
    assert np.hypot(*(nearest_points(region.border, xy) - xy).T).min() <= np.hypot(*(p - xy).T).min() + 1e-9


def test_convex_regions_on_a_ring_leave_its_hole_out(rings):
    ring = next(r for r in rings.regions if abs(r.point[2] - 0.25) < 0.01)
    for turn in np.linspace(0, 6, 12):
        polygon = convex_region(ring, (2 + 1.1 * np.cos(turn), -2.5 + 1.1 * np.sin(turn)))
        away = np.hypot(
            *(
                nearest_points(np.stack([polygon, np.roll(polygon, -1, 0)], 1)[..., :2], np.array([2, -2.5]))
                - (2, -2.5)
            ).T
        ).min()
        assert 0.5 < away < 0.7 and np.hypot(*(polygon[:, :2] - (2, -2.5)).T).max() < 1.65


def test_refuses_footholds_off_the_region():
    (region,) = block().regions
    for xy, margin in (((0.6, 0.0), 0.0), ((0.5, 0.0), 0.0), ((0.45, 0.0), 0.1)):
        with pytest.raises(ValueError, match="foothold_xy: must lie in the region"):
            convex_region(region, xy, margin)
    by_point, by_xy = (convex_region(region, at) for at in ((0.1, 0.2, 7.0), (0.1, 0.2)))
    np.testing.assert_array_equal(by_point, by_xy)
    for xy in ((0.0, np.nan), (0.0, 0.0, 0.0, 0.0), 1.0):
        with pytest.raises(ValueError, match="xy: must be two finite numbers"):
            convex_region(region, xy)
        with pytest.raises(ValueError, match="xy: must be two finite numbers"):
            block().nearest_foothold(xy)
    with pytest.raises(ValueError, match="margin"):
        convex_region(region, (0.0, 0.0), -0.1)
