"""OpenCV and SciPy calls that give what a filter gives: `peer(values, known) -> values`, NumPy arrays (H, W).

Values are float32, 0 where unknown. OpenCV knows no masks: where it smooths, values and mask are smoothed and divided.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import cv2
import numpy as np
import scipy.ndimage as ndimage
from numpy.typing import NDArray

RESOLUTION = 0.04  # [m]
_WINDOW = (5, 5)  # [cells]
Peer = Callable[[NDArray, NDArray], NDArray]


def _masked_mean(values: NDArray, known: NDArray, blur: Callable[[NDArray], NDArray]) -> NDArray:
    """Blur values and mask and divide the one by the other."""
    return blur(values) / np.maximum(blur(known.astype(np.float32)), 1e-6)


def cv_gaussian(values: NDArray, known: NDArray) -> NDArray:
    """Smooth with a Gaussian of the default sigma, 0.1 m, truncated at three sigma."""
    width = 2 * round(0.3 / RESOLUTION) + 1
    blur = functools.partial(
        cv2.GaussianBlur, ksize=(width, width), sigmaX=0.1 / RESOLUTION, borderType=cv2.BORDER_CONSTANT
    )
    return _masked_mean(values, known, blur)


def cv_box(values: NDArray, known: NDArray) -> NDArray:
    """Average windows of 5 x 5 cells."""
    return _masked_mean(values, known, lambda v: cv2.blur(v, _WINDOW, borderType=cv2.BORDER_CONSTANT))


def scipy_median(values: NDArray, known: NDArray) -> NDArray:
    """Take the median of windows of 3 x 3 cells, unknown ones included: neither library has a masked median."""
    return ndimage.median_filter(values, 3)


def cv_dilation(values: NDArray, known: NDArray) -> NDArray:
    """Take the maximum of windows of 5 x 5 cells; unknown cells count as lowest."""
    return cv2.dilate(np.where(known, values, np.float32(-1e9)), np.ones(_WINDOW, np.uint8))


def cv_erosion(values: NDArray, known: NDArray) -> NDArray:
    """Take the minimum of windows of 5 x 5 cells; unknown cells count as highest."""
    return cv2.erode(np.where(known, values, np.float32(1e9)), np.ones(_WINDOW, np.uint8))


def cv_step(values: NDArray, known: NDArray) -> NDArray:
    """Subtract the minimum of each window from its maximum."""
    return cv_dilation(values, known) - cv_erosion(values, known)


def cv_deviation(values: NDArray, known: NDArray) -> NDArray:
    """Compute the standard deviation of windows of 5 x 5 cells from the means of values and of squares."""
    number = np.maximum(cv2.blur(known.astype(np.float32), _WINDOW, borderType=cv2.BORDER_CONSTANT), 1e-6)
    mean = cv2.blur(values, _WINDOW, borderType=cv2.BORDER_CONSTANT) / number
    square = cv2.blur(values * values, _WINDOW, borderType=cv2.BORDER_CONSTANT) / number
    return np.sqrt(np.maximum(square - mean * mean, 0))


def scipy_inpaint_minimum(values: NDArray, known: NDArray) -> NDArray:
    """Fill each labelled hole with its lowest border cell."""
    labels, count = ndimage.label(~known, np.ones((3, 3)))
    if not count:
        return values
    lowest = ndimage.grey_erosion(np.where(known, values, 1e9), size=(3, 3))
    filling = ndimage.minimum(lowest, labels, np.arange(count + 1))
    return np.where(known, values, filling[labels])


def scipy_inpaint_nearest(values: NDArray, known: NDArray) -> NDArray:
    """Fill with the nearest known cell, by SciPy's distance transform."""
    i, j = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[i, j]


def cv_inpaint(values: NDArray, known: NDArray, method: int) -> NDArray:
    """Inpaint with a method of OpenCV, which takes 16 bits: heights are rounded to millimetres."""
    low = values.min()
    millimetres = np.round((values - low) * 1000).astype(np.uint16)
    return cv2.inpaint(millimetres, (~known).astype(np.uint8), 5, method) / 1000 + low


def cv_distance(values: NDArray, known: NDArray) -> NDArray:
    """Return the distance to the nearest step of 0.1 m or unknown cell, between cell centers."""
    edge = ~known | (cv2.dilate(values, np.ones((3, 3))) - cv2.erode(values, np.ones((3, 3))) > 0.1)
    return cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * RESOLUTION
