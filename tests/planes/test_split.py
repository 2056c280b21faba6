"""Cutting, growing, settling and merging regions, by hand and against loops."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchelev.planes import split as plane_split
from torchelev.planes.fits import Limits
from torchelev.planes.grow import _best_of_both, connected, grow, merge, near, settle
from torchelev.planes.split import split
from torchelev.planes.sums import find_runs, fit_planes, make_surface, region_moments, rimmed

pytest.importorskip("cv2")
SEEDS = st.integers(0, 10_000)
LIMITS = Limits(slope=0.7, roughness=0.01, distance=0.025, curvature=2.0)
RESOLUTION = 0.05


def ground(z):
    """The surface of heights (H, W), with the gradients of central differences."""
    gx, gy = np.gradient(z, RESOLUTION)
    return make_surface(np.ones(z.shape, bool), z - z.mean(), gx, gy, RESOLUTION, 1)


def flat(labels):
    return rimmed(np.asarray(labels), -1).ravel()


def image(labels, shape):
    return labels.reshape(shape[0] + 1, -1)[:-1, :-1]


def fit(labels, surface):
    return fit_planes(region_moments(surface, find_runs(labels), labels.max() + 1), None, surface.weight)


def cells(H, W):
    return np.meshgrid(np.arange(H) * RESOLUTION, np.arange(W) * RESOLUTION, indexing="ij")


def test_a_crease_is_cut_along_the_crease():
    x, _ = cells(40, 30)
    z = 0.3 * np.maximum(0, x - 1.0)
    labels, planes = split(flat(np.zeros((40, 30), int)), ground(z), LIMITS)
    found = image(labels, z.shape)
    assert len(np.unique(found[:18])) == len(np.unique(found[23:])) == 1 and found[0, 0] != found[-1, 0]
    np.testing.assert_allclose(planes.gradient_x[found[[0, -1], 0]], [0, 0.3], atol=0.03)
    assert planes.roughness[found[found >= 0]].max() <= LIMITS.roughness


def test_parallel_planes_are_cut_by_height():
    """Their gradients are the same: a shelf 6 cm up. No piece has cells of both; merged, two are left."""
    _, y = cells(30, 30)
    z = np.where(y > 0.72, 0.06, 0.0)
    surface = ground(z)._replace(gradient_x=np.zeros(31 * 31), gradient_y=np.zeros(31 * 31))
    labels, _ = split(flat(np.zeros((30, 30), int)), surface, LIMITS)
    found = image(labels, z.shape)
    assert not np.isin(found[:, :15], found[:, 15:]).any() and found.min() >= 0
    merged = image(merge(labels, surface, LIMITS.roughness, labels.max() + 1), z.shape)
    assert (merged[:, :15] == merged[0, 0]).all() and (merged[:, 15:] == merged[0, -1]).all()


def test_a_bump_on_a_planar_region_leaves_it():
    z = np.zeros((60, 60))
    z[10:14, 10:14] = 0.04
    labels, _ = split(flat(np.zeros((60, 60), int)), ground(z), LIMITS)
    found = image(labels, z.shape)
    assert (found[10:14, 10:14] == found[11, 11]).all() and found[11, 11] >= 0 and found[11, 11] != found[0, 0]
    assert (np.delete(found.ravel(), np.flatnonzero(z)) == found[0, 0]).all()


def test_a_slope_on_a_planar_region_leaves_it_in_one_piece():
    """Also while another region is being cut."""
    x, y = cells(60, 80)
    z = np.where((x > 0.99) & (x < 1.49) & (y > 0.99) & (y < 1.49), 0.03 + 0.09 * (x - 1.0), 0.0)
    z[:, 60:] = 0.3 * np.maximum(0, x[:, 60:] - 1.5)
    labels, _ = split(flat(np.repeat([0, 1], [60, 20])[None].repeat(60, 0)), ground(z), LIMITS)
    found = image(labels, z.shape)
    assert (found[20:30, 20:30] == found[25, 25]).all() and found[25, 25] not in (-1, found[0, 0])


def test_crumbs_of_a_cut_are_left_out():
    parts = np.repeat([0, 1, 2, 3], [3, 4, 1, 5])
    labels = plane_split._pieces((1, 14), np.arange(13), parts)
    assert labels.tolist()[:15] == [-1] * 3 + [0] * 4 + [-1] + [1] * 5 + [-1] * 2


@given(SEEDS)
def test_pieces_are_planar_and_hang_together(seed):
    rng = np.random.default_rng(seed)
    x, y = cells(40, 35)
    z = rng.uniform(0, 0.4) * np.sin(3 * x + rng.uniform(0, 6)) * np.cos(2 * y) + rng.uniform(0, 0.3) * (x * y > 1)
    z += rng.normal(0, 0.004, z.shape)
    start = rng.integers(0, 4, (4, 5)).repeat(10, 0).repeat(7, 1) - 1
    surface = ground(z)
    labels, planes = split(flat(start), surface, LIMITS)
    assert (image(labels, z.shape)[start < 0] == -1).all()
    own = fit(labels, surface)
    for k in np.unique(labels[labels >= 0]):
        assert len(np.unique(flat(start)[labels == k])) == 1
        assert own.roughness[k] <= LIMITS.roughness + 1e-9
    assert planes.roughness[labels[labels >= 0]].max(initial=0) <= LIMITS.roughness


def test_cutting_ends(monkeypatch):
    """What is left after the last round is dropped."""
    monkeypatch.setattr(plane_split, "MAX_CUTS", 2)
    x, y = cells(60, 60)
    labels, planes = split(flat(np.zeros((60, 60), int)), ground(0.3 * np.sin(4 * x) * np.sin(4 * y)), LIMITS)
    assert len(planes.number) >= labels.max() + 1
    assert (labels < 0).mean() > 0.5


@given(SEEDS)
def test_otsu_leaves_the_least_variance(seed):
    rng = np.random.default_rng(seed)
    histogram = rng.poisson(rng.choice([0.1, 1, 10]), (3, plane_split.BINS))
    histogram[:, [3, 50]] += 1
    bins = np.arange(plane_split.BINS)
    for row, cut in zip(histogram, plane_split._otsu(histogram), strict=True):

        def within(k, row=row):
            parts = [np.repeat(bins[part], row[part]) for part in (slice(0, k + 1), slice(k + 1, None))]
            return sum(((p - p.mean()) ** 2).sum() for p in parts if len(p))

        assert within(cut) <= min(within(k) for k in range(plane_split.BINS - 1)) + 1e-6
        assert 0 < row[: cut + 1].sum() < row.sum()


def test_growing_stops_at_steps_and_shares_creases():
    """Seeds on a level, a slope from i = 10 on, and a shelf from j = 20 on; unknown cells stay so."""
    x, y = cells(20, 30)
    z = np.where(y >= 20 * RESOLUTION, 1.0, 0.4 * np.maximum(0, x - 9.5 * RESOLUTION))
    seeds = np.full((20, 30), -1)
    seeds[2:7, 2:18], seeds[13:18, 2:18], seeds[2:18, 22:28] = 0, 1, 2
    known = np.ones((20, 30), bool)
    known[0, 0] = False
    slopes = np.zeros((20, 30))
    slopes[13:18, 2:18] = 0.4
    surface = make_surface(known, z, slopes, 0 * slopes, RESOLUTION, 1)
    plane = fit(flat(seeds), surface)
    found = image(grow(flat(seeds), plane, surface, 0.025, 6, contested=True), z.shape)
    expected = np.repeat([0, 1], 10)[:, None].repeat(30, 1)
    expected[:, 20:] = 2
    expected[0, 0] = -1
    np.testing.assert_array_equal(found, expected)
    one = image(grow(flat(seeds), plane, surface, 0.025, 1, contested=True), z.shape)
    assert (one[1, 2:18] == 0).all() and (one[0] == -1).all() and one[1, 1] == -1


def test_only_contested_cells_change_hands():
    z = np.zeros((6, 12))
    z[:, 6:] = 0.02
    wrong = np.repeat([0, 1], [8, 4])[None].repeat(6, 0)
    right = np.repeat([0, 1], 6)[None].repeat(6, 0)
    surface = ground(z)._replace(gradient_x=np.zeros(7 * 13), gradient_y=np.zeros(7 * 13))
    plane = fit(flat(right), surface)
    np.testing.assert_array_equal(image(grow(flat(wrong), plane, surface, 0.025, 3, contested=True), z.shape), right)
    np.testing.assert_array_equal(image(grow(flat(wrong), plane, surface, 0.025, 3, contested=False), z.shape), wrong)


@given(SEEDS)
def test_regions_that_grow_stay_in_one_piece(seed):
    """Many seeds beside each other that compete for cells: none is cut off from its region by another."""
    rng = np.random.default_rng(seed)
    z = rng.normal(0, 0.012, (40, 40))
    seeds = np.full((40, 40), -1)
    seeds[2::5, 2::5] = np.arange(64).reshape(8, 8)
    surface = ground(z)._replace(gradient_x=rng.normal(0, 0.05, 41 * 41), gradient_y=rng.normal(0, 0.05, 41 * 41))
    surface = make_surface(*(image(v, z.shape) for v in (surface.known, surface.z, *surface[5:7])), RESOLUTION, 1)
    found = grow(flat(seeds), fit(flat(seeds), surface), surface, 0.025, 6, contested=False)
    _, was = connected(found, z.shape, 1)
    assert sorted(was) == list(range(64)) and (found[flat(seeds) >= 0] == flat(seeds)[flat(seeds) >= 0]).all()


def test_pairs_merge_that_are_each_other_s_best():
    pairs = np.array([[0, 1, 2, 0], [1, 2, 3, 4]])
    best = _best_of_both(pairs, np.array([3.0, 1.0, 2.0, 4.0]), 5)
    np.testing.assert_array_equal(best, [[1], [2]])
    assert _best_of_both(pairs[:, :0], np.zeros(0), 5).shape == (2, 0)


def test_frayed_borders_settle_only_where_cells_lie_on_both_planes():
    labels = np.repeat([0, 1], [5, 5])[None].repeat(9, 0)
    labels[4, 5] = 0  # a tooth
    straight = np.repeat([0, 1], [5, 5])[None].repeat(9, 0)
    for step, expected in ((0.0, straight), (0.2, labels)):
        z = np.where(labels == 1, step, 0.0)
        surface = ground(z)._replace(gradient_x=np.zeros(10 * 11), gradient_y=np.zeros(10 * 11))
        plane = fit(flat(labels), surface)
        np.testing.assert_array_equal(image(settle(flat(labels), plane, surface, 0.025), z.shape), expected)


def test_stripes_of_one_plane_merge_and_those_of_another_do_not():
    """Stripes 0, 1, 2 level; 3 and 4 a slab that is higher by 4 cm, small beside the others."""
    labels = np.repeat([0, 1, 2, 3, 4], [10, 3, 20, 2, 2])[:, None].repeat(12, 1)
    z = np.where(labels >= 3, 0.04, 0.0) + np.random.default_rng(0).normal(0, 0.003, labels.shape)
    surface = ground(z)._replace(gradient_x=np.zeros(38 * 13), gradient_y=np.zeros(38 * 13))
    found = image(merge(flat(labels), surface, 0.01, 5), z.shape)[:, 0]
    assert len(set(found[:33])) == len(set(found[33:])) == 1 and found[0] != found[-1]


def test_regions_apart_do_not_merge():
    labels = np.repeat([0, -1, 1], 5)[:, None].repeat(6, 1)
    surface = ground(np.zeros(labels.shape))
    np.testing.assert_array_equal(image(merge(flat(labels), surface, 0.01, 2), labels.shape), labels)
    assert (merge(flat(np.full((4, 4), -1)), ground(np.zeros((4, 4))), 0.01, 0) == -1).all()


def test_connected_numbers_pieces_and_forgets_small_ones():
    labels = np.array([[5, 5, -1, 5], [7, 5, -1, 5], [7, -1, 7, 5]])
    found, was = connected(flat(labels), labels.shape, 2)
    np.testing.assert_array_equal(image(found, labels.shape), [[0, 0, -1, 1], [2, 0, -1, 1], [2, -1, -1, 1]])
    assert was.tolist() == [5, 5, 7]


def test_far_cells_leave():
    z = np.zeros((6, 6))
    z[2, 3], z[4, 4] = 0.03, -0.02
    surface = ground(z)
    level = fit(flat(np.zeros((6, 6), int)), make_surface(z == 0, 0 * z - z.mean(), 0 * z, 0 * z, RESOLUTION, 1))
    found = image(near(flat(np.zeros((6, 6), int)), level, surface, 0.025), z.shape)
    assert found[2, 3] == -1 and (found == 0).sum() == 35
