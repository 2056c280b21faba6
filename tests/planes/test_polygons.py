"""Points and polygons, against hand-worked values and loops."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchelev.planes.polygons import free_polygon, nearest_points, ray_crosses, sides

SEEDS = st.integers(0, 10_000)
SQUARE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 2.0], [0.0, 2.0]])


def star(rng, radius):
    """A polygon around the origin, not convex, with corners from a third of the radius on."""
    angle = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(5, 30)))
    return np.column_stack([np.cos(angle), np.sin(angle)]) * rng.uniform(radius / 3, radius, (len(angle), 1))


def is_inside(border, point):
    return ray_crosses(border, point).sum() % 2 == 1


def cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def test_sides_go_around_each_polygon():
    found = sides([SQUARE, SQUARE[:3] + 10])
    assert found.shape == (7, 2, 2)
    np.testing.assert_array_equal(found[3], [[0, 2], [0, 0]])
    np.testing.assert_array_equal(found[6], [[14, 12], [10, 10]])
    assert sides([]).shape == (0, 2, 2)


@pytest.mark.parametrize("point, inside", [((1, 1), 1), ((5, 1), 0), ((-1, 1), 0), ((1, 3), 0), ((3.9, 0.1), 1)])
def test_crossings_tell_the_inside(point, inside):
    assert ray_crosses(sides([SQUARE]), np.array(point)).sum() % 2 == inside


@given(SEEDS)
def test_crossings_agree_with_the_winding(seed):
    rng = np.random.default_rng(seed)
    polygon = star(rng, 1.0)
    for point in rng.uniform(-1, 1, (20, 2)):
        a, b = polygon - point, np.roll(polygon, -1, 0) - point
        winding = np.arctan2(cross(a, b), (a * b).sum(1)).sum() / (2 * np.pi)
        assert is_inside(sides([polygon]), point) == (abs(winding) > 0.5)


@pytest.mark.parametrize(
    "point, expected", [((1, -3), (1, 0)), ((9, 9), (4, 2)), ((3.5, 1), (4, 1)), ((-1, -1), (0, 0))]
)
def test_nearest_of_a_rectangle(point, expected):
    found = nearest_points(sides([SQUARE]), np.array(point, float))
    best = np.argmin(np.hypot(*(found - point).T))
    np.testing.assert_allclose(found[best], expected)


def test_nearest_of_a_side_without_length():
    np.testing.assert_array_equal(nearest_points(np.ones((1, 2, 2)), np.zeros(2)), [[1, 1]])


@pytest.mark.parametrize("margin", [0.0, 0.25])
def test_free_polygon_of_a_rectangle_is_the_rectangle(margin):
    found = free_polygon(sides([SQUARE]), np.array([1.0, 0.8]), margin)
    inner = [[margin, margin], [4 - margin, margin], [4 - margin, 2 - margin], [margin, 2 - margin]]
    assert len(found) == 4
    np.testing.assert_allclose(found[np.lexsort(found.T)], np.array(inner)[np.lexsort(np.array(inner).T)], atol=1e-12)


def test_free_polygon_beside_a_hole_by_hand():
    """A 4 x 2 rectangle with a hole over x in [2, 3], y in [0.5, 1.5], from (1, 1): what lies before x = 2."""
    hole = np.array([[2, 0.5], [2, 1.5], [3, 1.5], [3, 0.5]])
    found = free_polygon(sides([SQUARE, hole]), np.array([1.0, 1.0]), 0.0)
    np.testing.assert_allclose([found.min(0), found.max(0)], [[0, 0], [2, 2]], atol=1e-12)


@pytest.mark.slow(1)
@given(SEEDS, st.sampled_from([0.0, 0.05]))
def test_free_polygon_is_convex_around_the_seed_and_free(seed, margin):
    """Inside a star with a hole: counter-clockwise, and no point of the border inside or within the margin."""
    rng = np.random.default_rng(seed)
    hole = star(rng, 0.2)[::-1] + rng.uniform(-0.3, 0.3, 2)
    border = sides([star(rng, 3.0), hole])
    for point in rng.uniform(-1, 1, (4, 2)):
        clearance = np.hypot(*(nearest_points(border, point) - point).T).min()
        if not is_inside(border, point) or clearance < margin + 1e-3:
            continue
        found = free_polygon(border, point, margin)
        along = np.roll(found, -1, 0) - found
        assert (cross(along, np.roll(along, -1, 0)) > -1e-9).all()
        assert (cross(along, point - found) > 0).all()
        onto = border[:, :1] + np.linspace(0, 1, 8)[None, :, None] * (border[:, 1:] - border[:, :1])
        depth = cross(along, onto.reshape(-1, 1, 2) - found) / np.hypot(*along.T)
        assert depth.min(1).max() <= 1e-9  # every point of the border lies outside of a side
        normal = np.column_stack([along[:, 1], -along[:, 0]]) / np.hypot(*along.T)[:, None]
        feet = point + ((found - point) * normal).sum(1)[:, None] * normal + margin * normal
        reached = [np.hypot(*(nearest_points(border, foot) - foot).T).min() for foot in feet]
        assert max(reached) < 1e-6  # every side is a tangent where the circle touched the border
        assert cross(along, (feet - margin * normal)[:, None] - found).min() > -1e-6 or margin > 0
        away = [np.hypot(*(nearest_points(sides([found]), b) - b).T).min() for b in onto.reshape(-1, 2)]
        assert min(away) >= margin - 1e-9
        assert len(found) >= 3 and is_inside(border, found.mean(0))
