"""Regions that lie on one plane merge."""

import numpy as np
import pytest
from hypothesis import strategies as st

from tests.planes.surfaces import flat, ground, image
from torchelev.planes.merge import merge, mutually_best

pytest.importorskip("cv2")


SEEDS = st.integers(0, 10_000)


def test_pairs_merge_that_are_each_other_s_best():
    pairs = np.array([[0, 1, 2, 0], [1, 2, 3, 4]])
    best = mutually_best(pairs, np.array([3.0, 1.0, 2.0, 4.0]), 5)
    np.testing.assert_array_equal(best, [[1], [2]])
    assert mutually_best(pairs[:, :0], np.zeros(0), 5).shape == (2, 0)


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
