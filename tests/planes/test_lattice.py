"""Components, borders and insets of label images, against loops over cells."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchelev.planes.lattice import components, disc, interior, same_label, trace_borders, trace_insets

cv2 = pytest.importorskip("cv2")
SEEDS = st.integers(0, 10_000)
STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))


def random_labels(seed, values=3):
    """Random blotches of labels, -1 to values - 1."""
    rng = np.random.default_rng(seed)
    H, W = rng.integers(1, 12, 2)
    return rng.integers(-1, rng.integers(1, values + 1), (H, W))


def flood(labels):
    """What hangs together over the sides of cells with the same label, numbered in scan order."""
    found, count = np.full(labels.shape, -1), 0
    for start in np.ndindex(labels.shape):
        if labels[start] < 0 or found[start] >= 0:
            continue
        found[start], queue = count, [start]
        for i, j in queue:
            for di, dj in STEPS:
                at = (i + di, j + dj)
                inside = 0 <= at[0] < labels.shape[0] and 0 <= at[1] < labels.shape[1]
                if inside and labels[at] == labels[start] and found[at] < 0:
                    found[at] = count
                    queue.append(at)
        count += 1
    return found, count


def border_sides(labels, label):
    """The sides of cells at a region's border as pairs of corners, with the region on the left."""
    rimmed = np.pad(labels, 1, constant_values=-1)
    sides = set()
    for i, j in np.argwhere(labels == label):
        corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
        for k, (di, dj) in enumerate([(0, -1), (1, 0), (0, 1), (-1, 0)]):
            if rimmed[i + 1 + di, j + 1 + dj] != label:
                sides.add((corners[k], corners[(k + 1) % 4]))
    return sides


def unit_sides(polygon):
    """A polygon's sides in steps of one cell."""
    sides = []
    for a, b in zip(polygon, np.roll(polygon, -1, 0), strict=True):
        length = np.abs(b - a).max()
        points = [tuple((a + (b - a) * k // length).tolist()) for k in range(length + 1)]
        sides += list(zip(points[:-1], points[1:], strict=True))
    return sides


def polygons(outlines):
    return np.split(outlines.points, np.cumsum(outlines.length)[:-1])


@given(SEEDS)
def test_components_are_those_of_a_flood(seed):
    labels = random_labels(seed)
    found, count = components(*same_label(labels))
    expected, number = flood(labels)
    assert count == number
    pairs = set(zip(found.ravel().tolist(), expected.ravel().tolist(), strict=True))
    assert len(pairs) == len(np.unique(expected)) and all((a < 0) == (b < 0) for a, b in pairs)


def test_components_hang_together_over_joined_sides_alone():
    cells = np.ones((2, 3), bool)
    along_y = np.array([[True, False], [True, True]])
    labels, count = components(cells, np.zeros((1, 3), bool), along_y)
    assert count == 3
    np.testing.assert_array_equal(labels, [[0, 0, 1], [2, 2, 2]])


@given(SEEDS)
def test_borders_are_the_sides_of_the_cells(seed):
    """Every side once, the region on its left, one polygon around each region; so the areas are right too."""
    labels, count = components(*same_label(random_labels(seed)))
    outlines = trace_borders(interior(labels), labels)
    area = np.zeros(count)
    for label in range(count):
        mine = np.flatnonzero(outlines.label == label)
        assert (outlines.area[mine] > 0).sum() == 1
        sides = [side for k in mine for side in unit_sides(polygons(outlines)[k] // 2)]
        assert len(sides) == len(set(sides)) and set(sides) == border_sides(labels, label)
        area[label] = outlines.area[mine].sum() / 8
    np.testing.assert_array_equal(area, np.bincount(labels[labels >= 0], minlength=count))


def test_borders_of_a_ring_by_hand():
    """A corner of the ring is the first region; the cell in its hole the second, listed as hole and as region."""
    labels = np.zeros((3, 3), int)
    labels[1, 1] = 1
    outlines = trace_borders(interior(labels), labels)
    found = {
        (int(label), int(area)): {tuple(p) for p in polygon.tolist()}
        for polygon, label, area in zip(polygons(outlines), outlines.label, outlines.area, strict=True)
        if label >= 0
    }
    small = {(2, 2), (2, 4), (4, 2), (4, 4)}
    assert found == {(0, 72): {(0, 0), (0, 6), (6, 0), (6, 6)}, (0, -8): small, (1, 8): small}


def distance(sides, point):
    """From a point to the nearest of some sides."""
    start, along = sides[:, 0], sides[:, 1] - sides[:, 0]
    share = ((point - start) * along).sum(1).clip(0, 1)  # the sides have length 1
    return np.hypot(*(start + share[:, None] * along - point).T).min()


def surrounds(polygon, point):
    """Whether a polygon winds around a point, or has it on a side."""
    a, b = polygon - point, np.roll(polygon, -1, 0) - point
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    if ((cross == 0) & ((a * b).sum(1) <= 0)).any():
        return True
    return round(np.arctan2(cross, (a * b).sum(1)).sum() / (2 * np.pi)) != 0


@given(SEEDS, st.sampled_from([0.0, 0.6, 1.0, 1.5, 2.3]))
def test_insets_lie_far_enough_inside(seed, margin):
    """Corners lie in the region, the margin from its border; a cell's middle that does so, too, lies in an inset."""
    widths = np.random.default_rng(seed).integers(1, 5, 2)
    labels, count = components(*same_label(np.kron(random_labels(seed), np.ones(widths, int))))
    outlines = trace_insets(interior(labels), labels, margin)
    traced = polygons(outlines) if len(outlines.label) else []
    for label in range(count):
        sides = np.array(list(border_sides(labels, label)))
        mine = [polygon / 2 for polygon, of in zip(traced, outlines.label, strict=True) if of == label]
        for point in np.concatenate([np.zeros((0, 2)), *mine]):
            assert distance(sides, point) >= max(margin, 0.5) - 1e-3
            assert labels[tuple(point.astype(int))] == label
        for i, j in np.argwhere(labels == label):
            middle = np.array([i + 0.5, j + 0.5])
            if distance(sides, middle) >= max(margin, 0.5):
                assert any(surrounds(polygon, middle) for polygon in mine)


def test_insets_of_a_square_with_a_hole_by_hand():
    """9 x 9 cells without the middle one, 1 cell taken off: a square from 1 to 8; the hole grows from 1 to 3 cells."""
    labels = np.zeros((9, 9), int)
    labels[4, 4] = -1
    outlines = trace_insets(interior(labels), labels, 1.0)
    assert outlines.label.tolist() == [0, 0]
    outer, hole = sorted(zip(outlines.area, polygons(outlines), strict=True), key=lambda pair: -pair[0])
    assert outer[0] == 2 * 14**2 and {tuple(p) for p in outer[1].tolist()} == {(2, 2), (16, 2), (16, 16), (2, 16)}
    assert hole[0] < 0 and hole[1].min() == 6 and hole[1].max() == 12


def test_nothing_has_no_polygons():
    labels = np.full((4, 5), -1)
    assert components(*same_label(labels))[1] == 0
    assert (trace_borders(interior(labels), labels).label < 0).all() and len(
        trace_insets(interior(labels), labels, 1.0).label
    ) == 0


@pytest.mark.parametrize("reach", [1.0, 1.5, 2.0, math.sqrt(5), 3.9, 8.0])
def test_an_erosion_keeps_what_a_distance_transform_would(reach):
    image = (np.random.default_rng(0).random((61, 83)) < 0.98).astype(np.uint8)
    image[[0, -1]] = image[:, [0, -1]] = 0
    distance = cv2.distanceTransform(image, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    kept = cv2.erode(image, disc(reach - 1e-4))
    assert kept.any() and np.array_equal(kept, distance >= reach - 1e-4)
