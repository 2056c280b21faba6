"""Distances to borders by OpenCV on a CPU, with the same result as tensor operations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchelev.filters.opencv import fill_where_not

FAR = 1e30  # above all ground


def signed_cells(
    level: NDArray, known: NDArray, obstacle: NDArray | None, limit: float, unknown: bool, reach: float
) -> NDArray:
    """Return the distance [cells] of each cell to the nearest border, at most `reach`; negative inside obstacles.

    Obstacles are moved far above all ground and unknown cells far below it, or to NaN if they have no border: no
    difference to NaN exceeds a limit.
    """
    import cv2  # an optional dependency

    blank = -FAR if unknown else np.nan
    if obstacle is not None:
        level = fill_where_not(~obstacle, level, FAR)
    distance = nearest_seed(_beside_borders(fill_where_not(known, level, blank), limit, blank), reach)
    distance += 0.5
    image = distance.reshape(-1, distance.shape[2])
    cv2.threshold(image, reach, 0, cv2.THRESH_TRUNC, dst=image)
    return distance if obstacle is None else np.negative(distance, out=distance, where=obstacle)


def _beside_borders(level: NDArray, limit: float, blank: float) -> NDArray:
    """Return which cells (B, H, W) differ by more than `limit` from one of their four neighbours.

    Each map gets a rim of `blank`, so that all of them make one image.
    """
    import cv2

    B, H, W = level.shape
    rimmed = np.full((B, H + 2, W + 2), blank, np.float32)
    rimmed[:, 1:-1, 1:-1] = level
    image = rimmed.reshape(-1, W + 2)
    rows = cv2.absdiff(image[1:], image[:-1]) > limit
    columns = cv2.absdiff(image[1:-1, 1:], image[1:-1, :-1]) > limit
    beside = np.zeros((len(image), W), np.bool_)
    beside[1:-1] = rows[1:, 1:-1] | rows[:-1, 1:-1] | columns[:, 1:] | columns[:, :-1]
    return beside.reshape(B, H + 2, W)[:, 1:-1]


def nearest_seed(seeds: NDArray, if_none: float) -> NDArray:
    """Return the distance [cells] of each cell to the nearest seed of its map, `if_none` on maps without seeds."""
    import cv2

    distance = np.full(seeds.shape, if_none, np.float32)
    # OpenCV hands small maps to IPP, which takes twice as long. The switch applies to this thread alone.
    uses_ipp = cv2.ipp.useIPP()
    cv2.ipp.setUseIPP(False)
    try:
        for is_free, target in zip((~seeds).view(np.uint8), distance, strict=True):
            if not is_free.all():  # OpenCV's result without seeds is undefined
                cv2.distanceTransform(is_free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE, dst=target)
    finally:
        cv2.ipp.setUseIPP(uses_ipp)
    return distance
