"""The surfaces in a scan: whether they constrain the sensor's motion in every direction, and how far they moved."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_MIN_POINTS = 15  # of a surface: normals of fewer points are mostly noise
_FLATNESS = 10.0  # variance along a surface over that across it, at least
_THICKNESS = 4.0  # largest variance across a surface over the median of all: a corner in a cube is thicker
_MIN_SURFACES = 12
_ALIKE = 0.95  # cosine between the normals of one surface in two scans
_KNOWN = 5.0  # surfaces across a direction that show motion along it


class Surfaces(NamedTuple):
    """The points in each of K cubes that are flat."""

    keys: NDArray[np.int64]  #: (K,) of the cubes, see `cube_keys`
    means: NDArray[np.float64]  #: (K, 3) [m]
    axes: NDArray[np.float64]  #: (K, 3, 3) columns by growing variance; the first is the normal
    variances: NDArray[np.float64]  #: (K, 3) [m^2] along the axes
    counts: NDArray[np.int64]  #: (K,) of points


def measure_support(points: NDArray[np.float64], size: float) -> float:
    """Return how well a scan constrains translation along its worst direction, from 0 to 1/3.

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


def find_surfaces(points: NDArray[np.float64], size: float) -> Surfaces:
    """Return the flat surfaces among points (N, 3) [m], one for each cube of a side length [m]."""
    keys, mean, spread, count = _cubes(points, size)
    enough = count >= _MIN_POINTS
    keys, mean, count = keys[enough], mean[enough], count[enough]
    values, vectors = np.linalg.eigh(spread[enough])
    flat = values[:, 1] > _FLATNESS * values[:, 0]
    flat &= values[:, 0] <= _THICKNESS * np.median(values[flat, 0]) if flat.any() else flat
    return Surfaces(keys[flat], mean[flat], vectors[flat], np.maximum(values[flat], 1e-12), count[flat])


def measure_shift(before: Surfaces, after: Surfaces) -> NDArray[np.float64] | None:
    """Return the offset (3,) [m] of a scan's surfaces from those of an earlier one; None if too few match.

    It is the least-squares solution of n . shift = n . (m_after - m_before) over the cubes in both: walls count along
    their normals only, so that a pattern of points that moves with the sensor along a floor does not.
    """
    _, one, two = np.intersect1d(before.keys, after.keys, assume_unique=True, return_indices=True)
    normals = after.axes[two][:, :, 0]
    alike = np.abs(np.einsum("ka,ka->k", normals, before.axes[one][:, :, 0])) > _ALIKE
    if alike.sum() < _MIN_SURFACES:
        return None
    normals, apart = normals[alike], (after.means[two] - before.means[one])[alike]
    information = normals.T @ normals
    values, directions = np.linalg.eigh(information)
    known = values > _KNOWN
    along = directions[:, known].T @ (normals.T @ np.einsum("ka,ka->k", normals, apart))
    return directions[:, known] @ (along / values[known])


def _support(points: NDArray[np.float64], size: float) -> float:
    found = find_surfaces(points, size)
    if len(found.keys) < _MIN_SURFACES:
        return 0.0
    noise = found.variances[:, :1] / (found.counts[:, None] * found.variances[:, 1:])
    weights = np.concatenate([np.ones_like(noise[:, :1]), -noise], 1)
    information = np.einsum("kai,ki,kbi->ab", found.axes, weights, found.axes) / len(weights)
    return float(np.linalg.eigvalsh(information)[0])


def _cubes(points: NDArray[np.float64], size: float) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return keys (K,), means (K, 3) [m], covariances (K, 3, 3) [m^2] and numbers (K,) of the points in each cube."""
    keys, cube = np.unique(cube_keys(points, size), return_inverse=True)
    count = np.bincount(cube)
    mean = np.stack([np.bincount(cube, points[:, axis]) for axis in range(3)], -1) / count[:, None]
    rest = points - mean[cube]
    products = (rest[:, :, None] * rest[:, None, :]).reshape(-1, 9)
    spread = np.stack([np.bincount(cube, products[:, entry]) for entry in range(9)], -1) / count[:, None]
    return keys, mean, spread.reshape(-1, 3, 3), count


def cube_keys(points: NDArray[np.float64], size: float) -> NDArray[np.int64]:
    """Return a number (N,) for the cube of each point (N, 3), unique within 2^20 cubes of the origin."""
    index = np.floor(points / size).astype(np.int64) + 2**20
    return (index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]
