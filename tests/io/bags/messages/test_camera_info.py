"""Intrinsics are those of P where it is filled in; distortion that is not applied is said."""

from types import SimpleNamespace

import numpy as np
import pytest

from torchelev.io.bags.messages.camera_info import choose_matrix
from torchelev.io.bags.messages.cloud import CloudError

K = np.array([[60.0, 0, 47.5], [0, 61.0, 35.5], [0, 0, 1]])
RAW = K * [[0.8, 1, 1.1], [1, 0.8, 0.9], [1, 1, 1]]
P = np.column_stack([K, [-3.0, 0, 0]])
ZERO = np.zeros(9)
LENS = (-0.3, 0.1, 0.0, 0.0, 0.0)


def camera(k, p, d=(), ros=2):
    names = "kpd" if ros == 2 else "KPD"
    values = np.ravel(k), np.ravel(p), np.asarray(d)
    return SimpleNamespace(**dict(zip(names, values, strict=True)))


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize(
    ("k", "p"), [(K, P), (ZERO, P), (RAW, P), (K, np.zeros(12)), (K, ()), (K, np.full(12, np.nan))]
)
def test_p_is_taken_where_it_is_filled_in(k, p, ros):
    matrix, note = choose_matrix(camera(k, p, ros=ros))
    np.testing.assert_array_equal(matrix, K)
    assert note is None


def test_a_camera_without_focal_length_is_refused():
    with pytest.raises(CloudError, match="holds no calibration: the focal lengths of both P and K are not positive"):
        choose_matrix(camera(ZERO, np.zeros(12)))


@pytest.mark.parametrize(
    ("p", "d", "topic", "is_said"),
    [
        (P, LENS, "/depth/image_raw", True),
        (P, LENS, "/depth/image_rect_raw", False),  # rectified, and its matrix is known
        (np.zeros(12), LENS, "/depth/image_rect", True),  # K is that of the raw image
        (P, np.zeros(5), "/depth/image_raw", False),
        (P, (1e-5, 0, 0, 0), "/depth/image_raw", False),
    ],
)
def test_distortion_that_is_not_applied_is_said(p, d, topic, is_said):
    _, note = choose_matrix(camera(K, p, d), topic)
    assert (note is not None) == is_said
    if note:
        assert "distortion, coefficients up to 0.3, which is not applied" in note.text
