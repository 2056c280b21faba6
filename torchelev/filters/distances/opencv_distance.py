"""Distances to borders by OpenCV, on a CPU, to the same result as tensor operations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchelev.filters.opencv import filled

FAR = 1e30  # higher than any ground


def signed_cells(
    level: NDArray, known: NDArray, obstacle: NDArray | None, limit: float, unknown: bool, farthest: float
) -> NDArray:
    """Return the distance [cells] of each cell to the nearest border, at most `farthest`; negative in obstacles.

    Obstacles are put far above and unknown cells far below all ground, or, where these have no border, at NaN, from
    which nothing differs.
    """
    import cv2  # an optional dependency

    blank = -FAR if unknown else np.nan
    if obstacle is not None:
        level = filled(level, ~obstacle, FAR)
    away = nearest_seed(beside_borders(filled(level, known, blank), limit, blank), farthest)
    away += 0.5
    image = away.reshape(-1, away.shape[2])
    cv2.threshold(image, farthest, 0, cv2.THRESH_TRUNC, dst=image)
    return away if obstacle is None else np.negative(away, out=away, where=obstacle)


def beside_borders(level: NDArray, limit: float, blank: float) -> NDArray:
    """Tell which cells (B, H, W) differ by more than `limit` from one of the four beside them.

    `blank` lies around each map, so that all of them are one image.
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


def nearest_seed(seeds: NDArray, beyond: float) -> NDArray:
    """Return the distance [cells] of each cell to the nearest seed of its map; `beyond` where that has none."""
    import cv2

    away = np.full(seeds.shape, beyond, np.float32)
    # OpenCV leaves small maps to IPP, which takes twice as long. The switch is this thread's alone.
    uses_ipp = cv2.ipp.useIPP()
    cv2.ipp.setUseIPP(False)
    try:
        for blank, target in zip((~seeds).view(np.uint8), away, strict=True):
            if not blank.all():  # without seeds OpenCV returns anything
                cv2.distanceTransform(blank, cv2.DIST_L2, cv2.DIST_MASK_PRECISE, dst=target)
    finally:
        cv2.ipp.setUseIPP(uses_ipp)
    return away
