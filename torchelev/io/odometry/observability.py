"""Whether the surfaces in a scan constrain the motion of the sensor in every direction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_MIN_POINTS = 15  # of a surface: normals of fewer points are mostly noise
_FLATNESS = 10.0  # variance along a surface over that across it, at least
_THICKNESS = 4.0  # variance across a surface over the median of all, at most: a corner in a cube is thicker
_MIN_SURFACES = 12


def measure_support(points: NDArray[np.float64], size: float) -> float:
    """Return how well a scan constrains the translation in which it constrains it worst, from 0 to 1/3.

    The points in a cube are a surface with normal n. Returned is the smallest eigenvalue of the mean of n n^T over all
    surfaces, the mean squared cosine between the normals and the worst direction: 0 in an endless corridor and on a
    plane, 1/3 where normals point everywhere. The share that the noise of the normals adds, lambda_0 / N (e_1 e_1^T /
    lambda_1 + e_2 e_2^T / lambda_2) for N points of variances lambda, is subtracted. Sparse scans are also tried with
    cubes of twice the size.

    Args:
        points: [m] finite points (N, 3) of a scan, taken to one instant.
        size: [m] side length of the cubes.
    """
    return max(_support(points, size), _support(points, 2 * size))


def _support(points: NDArray[np.float64], size: float) -> float:
    spread, count = _cubes(points, size)
    values, vectors = np.linalg.eigh(spread[count >= _MIN_POINTS])
    count = count[count >= _MIN_POINTS]
    flat = values[:, 1] > _FLATNESS * values[:, 0]
    flat &= values[:, 0] <= _THICKNESS * np.median(values[flat, 0]) if flat.any() else flat
    if flat.sum() < _MIN_SURFACES:
        return 0.0
    values, vectors, count = np.maximum(values[flat], 1e-12), vectors[flat], count[flat]
    noise = values[:, :1] / (count[:, None] * values[:, 1:])
    weights = np.concatenate([np.ones_like(noise[:, :1]), -noise], 1)
    information = np.einsum("kai,ki,kbi->ab", vectors, weights, vectors) / len(values)
    return float(np.linalg.eigvalsh(information)[0])


def _cubes(points: NDArray[np.float64], size: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return covariances (K, 3, 3) [m^2] and numbers (K,) of the points in each cube."""
    _, cube = np.unique(cube_keys(points, size), return_inverse=True)
    count = np.bincount(cube)
    mean = np.stack([np.bincount(cube, points[:, axis]) for axis in range(3)], -1) / count[:, None]
    rest = points - mean[cube]
    products = (rest[:, :, None] * rest[:, None, :]).reshape(-1, 9)
    spread = np.stack([np.bincount(cube, products[:, entry]) for entry in range(9)], -1) / count[:, None]
    return spread.reshape(-1, 3, 3), count


def cube_keys(points: NDArray[np.float64], size: float) -> NDArray[np.int64]:
    """Return a number (N,) for the cube of each point (N, 3), unique within 2^20 cubes of the origin."""
    index = np.floor(points / size).astype(np.int64) + 2**20
    return (index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]
