"""Rays are those of P where images are rectified, else those of K without the distortion, which is said."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from torchelev.io.bags.messages.camera_info import choose_lens, pixel_rays
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
    lens, note = choose_lens(camera(k, p, ros=ros))
    assert lens.matrix == (60.0, 61.0, 47.5, 35.5) and not lens.distortion
    assert note is None


def test_a_camera_without_focal_length_is_refused():
    with pytest.raises(CloudError, match="holds no calibration: the focal lengths of both P and K are not positive"):
        choose_lens(camera(ZERO, np.zeros(12)))


@pytest.mark.parametrize(
    ("k", "p", "d", "topic", "words", "fx"),
    [
        (RAW, P, LENS, "/depth/image_raw", "which is removed", 48.0),
        (RAW, P, LENS, "/depth/image_rect_raw", "", 60.0),  # rectified, and its matrix is known
        (K, np.zeros(12), LENS, "/depth/image_rect", "not removed: the topic's name says that", 60.0),
        (ZERO, P, LENS, "/depth/image_raw", "not removed: K is missing", 60.0),
        (RAW, P, (1.0, 2.0), "/depth/image_raw", "not removed: its model '' with 2 coefficients is not known", 60.0),
        (RAW, P, LENS, "/direct/image", "which is removed", 48.0),
        (RAW, P, np.zeros(5), "/depth/image_raw", "", 60.0),
        (RAW, P, (1e-5, 0, 0, 0), "/depth/image_raw", "", 60.0),
    ],
)
def test_what_becomes_of_a_distortion_is_said(k, p, d, topic, words, fx):
    lens, note = choose_lens(camera(k, p, d), topic)
    assert lens.matrix[0] == fx and bool(lens.distortion) == ("which is removed" in words)
    assert words in (note.text if note else "") and bool(note) == bool(words)


@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial", "equidistant"])
def test_distortion_is_removed_to_a_thousandth_of_a_pixel(model):
    D = {"plumb_bob": LENS, "rational_polynomial": (0.5, -0.2, 1e-3, -1e-3, 0.05, 0.6, -0.1, 0.02)}
    D = D.get(model, (0.05, -0.01, 2e-3, -1e-3))
    lens, _ = choose_lens(SimpleNamespace(k=K.ravel(), p=P.ravel(), d=D, distortion_model=model), "/depth/image_raw")
    x, y = (rays.astype(np.float64) for rays in pixel_rays(lens, 72, 96))
    u, v = distorted(x, y, D, model)
    expected_v, expected_u = np.mgrid[:72, :96]
    np.testing.assert_allclose(60 * u + 47.5, expected_u, atol=1e-3)
    np.testing.assert_allclose(61 * v + 35.5, expected_v, atol=1e-3)
    assert abs(60 * x[0, 0] + 47.5) > 0.3  # it moves the corner


def distorted(x, y, D, model):
    """What the lens makes of rays (x, y, 1), by the formulas of ROS's image_pipeline."""
    r2 = x**2 + y**2
    if model == "equidistant":
        r = np.sqrt(r2)
        angle = np.arctan(r)
        scale = angle * (1 + sum(k * angle ** (2 * n + 2) for n, k in enumerate(D))) / r
        return x * scale, y * scale
    k1, k2, p1, p2, k3, *rest = (*D, 0.0, 0.0, 0.0)[:8]
    k4, k5, k6 = rest
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    return u, y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y


def test_a_distortion_without_opencv_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    lens, _ = choose_lens(camera(K, P, (0.123, 0.0, 0.0, 0.0)), "/depth/image_raw")
    with pytest.raises(CloudError, match="which only OpenCV removes: install opencv-python-headless"):
        pixel_rays(lens, 7, 9)
