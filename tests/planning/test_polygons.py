"""Cells in polygons: by hand, against loops, and what must not matter."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchelev.planning.polygons import convex_hull, rasterize

SEEDS = st.integers(0, 10_000)
SIZE = 13


def marks(polygon, size=SIZE):
    """The cells (i, j) of one polygon, in cells from the origin."""
    uv = torch.from_numpy(np.array(polygon, dtype=np.float64))[None, None]
    first, inside = rasterize(uv, size)
    return {(int(i + first[0, 0, 0]), int(j + first[0, 0, 1])) for i, j in inside[0, 0].nonzero()}


def square(low, high):
    return [(low, low), (high, low), (high, high), (low, high)]


def star(rng, vertices=None, radius=6.0, grain=None):
    """A polygon that is not convex, around a random place; on a grid of 1 / grain cells."""
    vertices = vertices or int(rng.integers(3, 9))
    angle = np.sort(rng.uniform(0, 2 * math.pi, vertices))
    away = rng.uniform(0.1, 1.0, vertices) * rng.uniform(0.2, radius)
    polygon = rng.uniform(-20, 20, 2) + away[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return polygon if grain is None else np.round(polygon * grain) / grain


def crossing(rng, vertices=6, radius=6.0):
    """A polygon whose edges cross each other."""
    return rng.uniform(-20, 20, 2) + rng.uniform(-radius, radius, (vertices, 2))


def loop_holds(polygon, x, y):
    """The even-odd rule, by a ray towards +x."""
    odd = False
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, 0), strict=True):
        if (ay > y) != (by > y) and x < ax + (y - ay) * (bx - ax) / (by - ay):
            odd = not odd
    return odd


def loop_cells(polygon):
    """The cells whose centres a polygon holds."""
    low, high = np.floor(polygon.min(0)).astype(int), np.ceil(polygon.max(0)).astype(int)
    around = ((i, j) for i in range(low[0], high[0]) for j in range(low[1], high[1]))
    return {(i, j) for i, j in around if loop_holds(polygon, i + 0.5, j + 0.5)}


def loop_touched(polygon, steps):
    """The cells that finely sampled edges pass."""
    cells = set()
    for a, b in zip(polygon, np.roll(polygon, -1, 0), strict=True):
        cells |= {tuple(np.floor(a + (b - a) * k / steps).astype(int).tolist()) for k in range(steps + 1)}
    return cells


def test_centres_by_hand():
    assert marks(square(0.0, 2.0)) == {(0, 0), (0, 1), (1, 0), (1, 1)}
    assert marks(square(-0.4, 1.4)) == {(0, 0)}
    # A triangle: right of x = 0 and below y = 4 - x; of the cells on its slanted edge, none has its centre below it.
    assert marks([(0.0, 0.0), (3.9, 0.0), (0.0, 3.9)]) == {(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0)}
    # An L.
    bent = [(0, 0), (3, 0), (3, 1), (1, 1), (1, 2), (0, 2)]
    assert marks(bent) == {(0, 0), (1, 0), (2, 0), (0, 1)}


def test_what_lies_around_twice_is_outside():
    """A pentagram's middle, by the even-odd rule."""
    corner = [(6 + 6 * math.cos(a), 6 + 6 * math.sin(a)) for a in (0.1 + 4 * math.pi * k / 5 for k in range(5))]
    found = marks(corner)
    assert (6, 6) not in found and (5, 5) not in found and len(found) > 20


def test_a_centre_on_an_edge_belongs_to_one_side():
    left, right = [(0, 0), (2.5, 0), (2.5, 4), (0, 4)], [(2.5, 0), (5, 0), (5, 4), (2.5, 4)]
    assert not marks(left) & marks(right) and len(marks(left) | marks(right)) == 20
    below, above = [(0, 0), (4, 0), (4, 4)], [(0, 0), (4, 4), (0, 4)]  # the diagonal passes four centres
    assert not marks(below) & marks(above) and len(marks(below) | marks(above)) == 16


def test_small_and_narrow_polygons_have_cells():
    assert marks([(3.1, -2.1), (3.2, -2.1), (3.2, -2.2)]) == {(3, -3)}
    assert marks([(3.1, 4.2)] * 3) == {(3, 4)}
    assert marks(square(0.9, 1.1)) == {(0, 0), (0, 1), (1, 0), (1, 1)}
    between = [(0.6, 0.1), (0.9, 0.1), (0.9, 5.9), (0.6, 5.9)]  # passes beside the centres
    assert marks(between) == {(0, j) for j in range(6)}
    assert marks([(y, x) for x, y in between]) == {(j, 0) for j in range(6)}


@pytest.mark.slow(1)
@given(SEEDS)
def test_marks_agree_with_loops(seed):
    rng = np.random.default_rng(seed)
    for make in (star, crossing) * 5:
        polygon = make(rng)
        expected = loop_cells(polygon)
        found = marks(polygon)
        if expected:
            assert found == expected == marks(polygon, SIZE + 3)
        else:
            assert found and found <= loop_touched(polygon, 1000)


@pytest.mark.slow(1)
@given(SEEDS)
def test_narrow_polygons_have_no_gaps(seed):
    """Cells that an edge is in for long are never left out: those that a sample a cell's 0.71 apart must meet."""
    rng = np.random.default_rng(seed)
    start, angle = rng.uniform(-5, 5, 2), rng.uniform(-4, 4)
    along = np.array([math.cos(angle), math.sin(angle)])
    points = start + np.linspace(0, 10, 1001)[:, None] * along
    cells, counts = np.unique(np.floor(points).astype(int), axis=0, return_counts=True)
    found = marks([start, start + 5 * along, start + 10 * along])
    assert {tuple(c) for c, n in zip(cells.tolist(), counts, strict=True) if n > 75} <= found
    assert found <= {tuple(c) for c in cells.tolist()} | loop_touched(np.array([start, start + 10 * along]), 10_000)


@pytest.mark.slow(1)
@given(SEEDS, st.booleans())
def test_order_orientation_padding_and_place_do_not_matter(seed, narrow):
    rng = np.random.default_rng(seed)
    for _ in range(5):
        polygon = star(rng, grain=64)  # so that moving it by whole cells is exact
        if narrow:
            polygon = polygon[:1] + (polygon - polygon[:1]) * [1.0, 0.0625]
        found = marks(polygon)
        assert found == marks(np.roll(polygon, int(rng.integers(1, 5)), 0)) == marks(polygon[::-1])
        assert found == marks(np.concatenate([polygon, polygon[-1:], polygon[-1:]]))
        shift = rng.integers(-1000, 1000, 2)
        assert marks(polygon + shift) == {(i + shift[0], j + shift[1]) for i, j in found}


def test_batches_of_polygons_equal_single_ones():
    rng = np.random.default_rng(0)
    polygons = np.stack([[star(rng, 5) for _ in range(7)] for _ in range(3)])
    first, inside = rasterize(torch.from_numpy(polygons), SIZE)
    for b in range(3):
        for p in range(7):
            single = rasterize(torch.from_numpy(polygons[b : b + 1, p : p + 1]), SIZE)
            assert torch.equal(single.first[0, 0], first[b, p]) and torch.equal(single.inside[0, 0], inside[b, p])


def test_no_polygons():
    assert rasterize(torch.zeros(2, 0, 4, 2).double(), 5).inside.shape == (2, 0, 5, 5)


# Hulls ----------------------------------------------------------------------------------------------------------------


def cells_at(*places, size=6):
    grid = np.zeros((size, size), dtype=bool)
    for i, j in places:
        grid[i, j] = True
    return grid


def test_hulls_by_hand():
    assert convex_hull(cells_at()).shape == (0, 2)
    assert convex_hull(cells_at((2, 3))).tolist() == [[2, 3], [3, 3], [3, 4], [2, 4]]
    assert convex_hull(cells_at((0, 0), (1, 0), (2, 0))).tolist() == [[0, 0], [3, 0], [3, 1], [0, 1]]
    assert convex_hull(cells_at((0, 0), (2, 2))).tolist() == [[0, 0], [1, 0], [3, 2], [3, 3], [2, 3], [0, 1]]


@given(SEEDS)
def test_hulls_are_convex_and_hold_their_cells(seed):
    rng = np.random.default_rng(seed)
    cells = rng.uniform(size=(7, 9)) < rng.uniform(0.02, 0.6)
    hull = convex_hull(cells)
    assert (len(hull) == 0) == (not cells.any())
    along = np.roll(hull, -1, 0) - hull
    turns = np.roll(along, -1, 0)
    assert (along[:, 0] * turns[:, 1] - along[:, 1] * turns[:, 0] > 0).all(), "counter-clockwise, no vertex on an edge"
    for i, j in np.argwhere(cells):
        for corner in ((i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)):
            offset = corner - hull
            assert (along[:, 0] * offset[:, 1] - along[:, 1] * offset[:, 0] >= 0).all()
    corners = {(i + a, j + b) for i, j in np.argwhere(cells).tolist() for a in (0, 1) for b in (0, 1)}
    assert {tuple(vertex) for vertex in hull.astype(int).tolist()} <= corners
