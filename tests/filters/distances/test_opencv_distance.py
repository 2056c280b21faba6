"""Distances to the nearest seed by OpenCV."""

import numpy as np
import pytest
from hypothesis import strategies as st

from torchelev.filters.distances.opencv_distance import nearest_seed

SEEDS = st.integers(0, 10_000)


def test_a_map_without_seeds_is_as_far_away_as_it_is_told():
    seeds = np.zeros((3, 30, 20), bool)
    seeds[1, 3, 4] = True
    away = nearest_seed(seeds, 40.0)
    assert (away[[0, 2]] == 40).all() and away[1, 3, 4] == 0 and away[1, 6, 8] == 5


@pytest.mark.parametrize("uses", [True, False])
def test_the_switch_of_ipp_is_put_back(uses, monkeypatch):
    cv2 = pytest.importorskip("cv2")
    seeds, before, during = np.eye(30, dtype=bool)[None], cv2.ipp.useIPP(), []

    def failing(*args, **settings):
        during.append(cv2.ipp.useIPP())
        raise RuntimeError

    try:
        cv2.ipp.setUseIPP(uses)
        kept = cv2.ipp.useIPP()  # False where OpenCV has no IPP
        nearest_seed(seeds, 40.0)
        assert cv2.ipp.useIPP() == kept
        monkeypatch.setattr(cv2, "distanceTransform", failing)
        with pytest.raises(RuntimeError):
            nearest_seed(seeds, 40.0)
        assert cv2.ipp.useIPP() == kept and during == [False]
    finally:
        cv2.ipp.setUseIPP(before)
