"""Coverage and errors of a map at held-out points and on the driven path."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchelev.io.export import SavedMap

_LIDAR_HEIGHT = 0.48  # [m] of the lidar of `offroad` above the ground, from the recording's notes
FLAT_SPAN, FLAT_POINTS = 0.10, 3  # largest height difference [m] and fewest held-out points of a flat cell


def _locate(points: NDArray, saved: SavedMap) -> tuple[NDArray, NDArray]:
    """Return the flat cell number (N,) of each point, and which points lie in the window."""
    shape = np.array(saved.layers["elevation"].shape)
    ij = np.floor((points[:, :2] - saved.center[:2]) / saved.resolution + shape / 2).astype(int)
    inside = np.all((ij >= 0) & (ij < shape), axis=1)
    return np.where(inside, ij[:, 0] * shape[1] + ij[:, 1], 0), inside


def mean_map(points: NDArray, saved: SavedMap) -> NDArray:
    """Return the mean height of the points in each cell (H, W) [m], NaN where there are none."""
    cells, inside = _locate(points, saved)
    size = saved.layers["elevation"].size
    count = np.bincount(cells[inside], minlength=size)
    total = np.bincount(cells[inside], points[inside, 2], minlength=size)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(saved.layers["elevation"].shape)


def _on_flat_cells(points: NDArray, saved: SavedMap) -> NDArray:
    """Return which points (N,) lie on flat cells."""
    cells, inside = _locate(points, saved)
    low, high = (np.full(saved.layers["elevation"].size, v) for v in (np.inf, -np.inf))
    np.minimum.at(low, cells[inside], points[inside, 2])
    np.maximum.at(high, cells[inside], points[inside, 2])
    count = np.bincount(cells[inside], minlength=low.size)
    flat: NDArray = (high - low < FLAT_SPAN) & (count >= FLAT_POINTS)
    return inside & flat[cells]


def held_out_figures(elevation: NDArray, points: NDArray, saved: SavedMap) -> dict[str, float]:
    """Return coverage and absolute errors [m] of an elevation (H, W) at held-out points."""
    cells, inside = _locate(points, saved)
    value = elevation.ravel()[cells]
    known = inside & np.isfinite(value)
    error = np.abs(value - points[:, 2])
    flat = error[known & _on_flat_cells(points, saved)]
    return {
        "coverage": float(known.sum() / inside.sum()),
        "flat_median_m": float(np.median(flat)),
        "flat_p90_m": float(np.percentile(flat, 90)),
        "flat_points": len(flat),
        "all_median_m": float(np.median(error[known])),
        "all_p90_m": float(np.percentile(error[known], 90)),
    }


def driven_figures(elevation: NDArray, driven: NDArray, saved: SavedMap) -> dict[str, float]:
    """Return coverage and absolute errors [m] at the cells that the robot drove over, each counted once.

    The true height is that of the lidar minus its height above the ground, 0.48 m.
    """
    cell = np.unique(_locate(driven, saved)[0])
    ground = mean_map(driven, saved).ravel()[cell] - _LIDAR_HEIGHT
    value = elevation.ravel()[cell]
    known = np.isfinite(value)
    error = np.abs(value - ground)[known]
    return {
        "driven_cells": len(cell),
        "driven_coverage": float(known.mean()),
        "driven_median_m": float(np.median(error)),
        "driven_p90_m": float(np.percentile(error, 90)),
    }


def traversable_fraction(saved: SavedMap, driven: NDArray) -> float:
    """Return the fraction of the driven cells with a traversability above 0.5, among those where it is known."""
    value = saved.layers["traversability"].ravel()[np.unique(_locate(driven, saved)[0])]
    return float((value[np.isfinite(value)] > 0.5).mean())
