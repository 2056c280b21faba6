"""Growing, smoothing and relabelling regions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.planes.surfaces import RESOLUTION, cells, fit, flat, ground, image
from torchelev.planes.grow import drop_distant, grow, relabel_components, smooth_borders
from torchelev.planes.sums import make_surface

pytest.importorskip("cv2")


SEEDS = st.integers(0, 10_000)


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
    found = image(grow(flat(seeds), plane, surface, 0.025, 6, may_take_over=True), z.shape)
    expected = np.repeat([0, 1], 10)[:, None].repeat(30, 1)
    expected[:, 20:] = 2
    expected[0, 0] = -1
    np.testing.assert_array_equal(found, expected)
    one = image(grow(flat(seeds), plane, surface, 0.025, 1, may_take_over=True), z.shape)
    assert (one[1, 2:18] == 0).all() and (one[0] == -1).all() and one[1, 1] == -1


def test_only_contested_cells_change_hands():
    z = np.zeros((6, 12))
    z[:, 6:] = 0.02
    wrong = np.repeat([0, 1], [8, 4])[None].repeat(6, 0)
    right = np.repeat([0, 1], 6)[None].repeat(6, 0)
    surface = ground(z)._replace(gradient_x=np.zeros(7 * 13), gradient_y=np.zeros(7 * 13))
    plane = fit(flat(right), surface)
    np.testing.assert_array_equal(
        image(grow(flat(wrong), plane, surface, 0.025, 3, may_take_over=True), z.shape), right
    )
    np.testing.assert_array_equal(
        image(grow(flat(wrong), plane, surface, 0.025, 3, may_take_over=False), z.shape), wrong
    )


@given(SEEDS)
def test_regions_that_grow_stay_in_one_piece(seed):
    """Many seeds beside each other that compete for cells: none is cut off from its region by another."""
    rng = np.random.default_rng(seed)
    z = rng.normal(0, 0.012, (40, 40))
    seeds = np.full((40, 40), -1)
    seeds[2::5, 2::5] = np.arange(64).reshape(8, 8)
    surface = ground(z)._replace(gradient_x=rng.normal(0, 0.05, 41 * 41), gradient_y=rng.normal(0, 0.05, 41 * 41))
    surface = make_surface(*(image(v, z.shape) for v in (surface.known, surface.z, *surface[5:7])), RESOLUTION, 1)
    found = grow(flat(seeds), fit(flat(seeds), surface), surface, 0.025, 6, may_take_over=False)
    _, was = relabel_components(found, z.shape, 1)
    assert sorted(was) == list(range(64)) and (found[flat(seeds) >= 0] == flat(seeds)[flat(seeds) >= 0]).all()


def test_frayed_borders_settle_only_where_cells_lie_on_both_planes():
    labels = np.repeat([0, 1], [5, 5])[None].repeat(9, 0)
    labels[4, 5] = 0  # a tooth
    straight = np.repeat([0, 1], [5, 5])[None].repeat(9, 0)
    for step, expected in ((0.0, straight), (0.2, labels)):
        z = np.where(labels == 1, step, 0.0)
        surface = ground(z)._replace(gradient_x=np.zeros(10 * 11), gradient_y=np.zeros(10 * 11))
        plane = fit(flat(labels), surface)
        np.testing.assert_array_equal(image(smooth_borders(flat(labels), plane, surface, 0.025), z.shape), expected)


def test_connected_numbers_pieces_and_forgets_small_ones():
    labels = np.array([[5, 5, -1, 5], [7, 5, -1, 5], [7, -1, 7, 5]])
    found, was = relabel_components(flat(labels), labels.shape, 2)
    np.testing.assert_array_equal(image(found, labels.shape), [[0, 0, -1, 1], [2, 0, -1, 1], [2, -1, -1, 1]])
    assert was.tolist() == [5, 5, 7]


def test_far_cells_leave():
    z = np.zeros((6, 6))
    z[2, 3], z[4, 4] = 0.03, -0.02
    surface = ground(z)
    level = fit(flat(np.zeros((6, 6), int)), make_surface(z == 0, 0 * z - z.mean(), 0 * z, 0 * z, RESOLUTION, 1))
    found = image(drop_distant(flat(np.zeros((6, 6), int)), level, surface, 0.025), z.shape)
    assert found[2, 3] == -1 and (found == 0).sum() == 35
