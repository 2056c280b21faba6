"""The rays of a depth image's pixels out of its CameraInfo."""

from __future__ import annotations

import functools
import re
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.messages.cloud import CloudError, Note

_DISTORTED = 1e-3  # largest coefficient of a lens that counts as free of distortion
_FISHEYE = ("equidistant", "fisheye")
_NUM_COEFFICIENTS = (4, 5, 8, 12, 14)
_MODELS = ("", "plumb_bob", "rational_polynomial", *_FISHEYE)


class Lens(NamedTuple):
    """How a camera projects."""

    matrix: tuple[float, float, float, float]  #: fx, fy, cx, cy [pixels]
    distortion: tuple[float, ...] = ()  #: coefficients of the images; (): they are rectified
    is_fisheye: bool = False  #: the coefficients are those of an equidistant lens


def choose_lens(camera: Any, topic: str = "") -> tuple[Lens, Note | None]:
    """Return the projection of an image: that of P if it is rectified, else that of K with the distortion D.

    Images are taken as rectified if their topic has "rect" in its name, or the lens has no distortion. Some drivers
    fill in only one of the matrices.

    Args:
        camera: a sensor_msgs/CameraInfo.
        topic: of the images.

    Returns:
        The lens, and a note on a distortion that is removed or cannot be.

    Raises:
        CloudError: neither P nor K is filled in.
    """
    P, K = _numbers(camera, "p", 12).reshape(3, 4)[:, :3], _numbers(camera, "k", 9).reshape(3, 3)
    D = _numbers(camera, "d", 0)
    given = {name: matrix for name, matrix in (("P", P), ("K", K)) if _is_calibrated(matrix)}
    if not given:
        raise CloudError("the CameraInfo holds no calibration: the focal lengths of both P and K are not positive")
    lens = _lens(next(iter(given.values())))
    if not (np.abs(D) > _DISTORTED).any() or (_is_rectified(topic) and "P" in given):
        return lens, None
    text = f"the CameraInfo has a distortion, coefficients up to {np.abs(D).max():.3g}"
    model = getattr(camera, "distortion_model", "")
    if _is_rectified(topic) or "K" not in given or model not in _MODELS or len(D) not in _NUM_COEFFICIENTS:
        text = f"{text}, which is not removed: {_why_not(topic, given, model, len(D))}"
        return lens, Note(f"{text}; its images are taken as rectified", "distortion")
    note = Note(f"{text}, which is removed: without rect in the topic's name, images are not rectified", "distortion")
    return _lens(K)._replace(distortion=tuple(D.tolist()), is_fisheye=model in _FISHEYE), note


def _is_rectified(topic: str) -> bool:
    """Return whether a topic's name says that its images are rectified."""
    return re.search(r"(^|[/_])rect", topic) is not None


def _why_not(topic: str, given: dict[str, Any], model: str, number: int) -> str:
    if _is_rectified(topic):
        return "the topic's name says that images are rectified, but P, their matrix, is missing"
    return "K is missing" if "K" not in given else f"its model {model!r} with {number} coefficients is not known"


@functools.lru_cache(maxsize=8)
def pixel_rays(lens: Lens, height: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return x and y of each pixel's ray at a depth of 1, (h, w) each, in optical axes. Kept for a few cameras."""
    fx, fy, cx, cy = lens.matrix
    v, u = np.mgrid[:height, :width].astype(np.float64)
    if not lens.distortion:
        return ((u - cx) / fx).astype(np.float32), ((v - cy) / fy).astype(np.float32)
    try:
        import cv2  # which few cameras need
    except ModuleNotFoundError as error:
        text = "the lens has a distortion, which only OpenCV removes: install opencv-python-headless"
        raise CloudError(f"{text}, or give the topic of rectified images") from error
    pixels, matrix = np.stack([u, v], -1).reshape(-1, 1, 2), np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    coefficients = np.array(lens.distortion)
    if lens.is_fisheye:
        rays = cv2.fisheye.undistortPoints(pixels, matrix, coefficients[:4])
    else:
        undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # of OpenCV 4; else of OpenCV 5
        until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)  # the default stops after five steps
        rays = undistort(pixels, matrix, coefficients, R=None, P=None, criteria=until)
    x, y = rays.reshape(height, width, 2).astype(np.float32).transpose(2, 0, 1)
    return np.ascontiguousarray(x), np.ascontiguousarray(y)


def _lens(matrix: NDArray[np.float64]) -> Lens:
    return Lens((matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))


def _numbers(camera: Any, name: str, num: int) -> NDArray[np.float64]:
    """Return an array by its name, in capitals in ROS 1 and lower case in ROS 2; zeros where it is missing."""
    values = np.asarray(getattr(camera, name.upper(), getattr(camera, name, ())), dtype=np.float64).ravel()
    return values if len(values) == num or not num else np.zeros(num)


def _is_calibrated(matrix: NDArray[np.float64]) -> bool:
    return bool(np.isfinite(matrix).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0)
