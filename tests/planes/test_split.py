"""Cutting, growing, settling and merging regions, by hand and against loops."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.planes.surfaces import LIMITS, cells, fit, flat, ground, image
from torchelev.planes import split as plane_split
from torchelev.planes.merge import merge
from torchelev.planes.split import split

pytest.importorskip("cv2")


SEEDS = st.integers(0, 10_000)


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
    labels = plane_split.label_pieces((1, 14), np.arange(13), parts)
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
    for row, cut in zip(histogram, plane_split.otsu_thresholds(histogram), strict=True):

        def within(k, row=row):
            parts = [np.repeat(bins[part], row[part]) for part in (slice(0, k + 1), slice(k + 1, None))]
            return sum(((p - p.mean()) ** 2).sum() for p in parts if len(p))

        assert within(cut) <= min(within(k) for k in range(plane_split.BINS - 1)) + 1e-6
        assert 0 < row[: cut + 1].sum() < row.sum()
