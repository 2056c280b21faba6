"""How well scans fit together under their poses, or under poses in which a mistake is undone.

Scans fit if the largest plane in each is level and lies below the sensor, and if they agree where they overlap.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_NUM_PLANES = 80  # random planes per scan (RANSAC)
_MAX_DISTANCE = 10.0  # [m] of the points from their sensor
_CELL_SIZE = 0.15  # [m] of the cells in which scans are compared
_TOLERANCE = 0.08  # [m] within which scans agree in a cell
MIN_CELLS = 40  # cells that a comparison of scans must rest on


@dataclass(frozen=True)
class Scan:
    """One sensor's finite points in one update, and its pose."""

    points: NDArray  #: (n, 3) [m] sensor frame
    T: NDArray  #: (4, 4) T_map_sensor
    base: NDArray | None = None  #: (4, 4) T_map_base; None where none was given


class Plane(NamedTuple):
    """The plane that holds most points of a scan, in the sensor frame: normal . p = offset."""

    normal: NDArray  #: (3,) unit vector
    offset: float  #: [m] from the sensor, along the normal


class Fit(NamedTuple):
    """How well scans fit together; NaN where they do not show it."""

    level: float  #: median cosine between the planes' normals and the vertical
    lowest: float  #: lowest cosine of these
    agreement: float  #: fraction of the shared cells in which scans have the same height
    bounce: float  #: [m] standard deviation of the sensor's height over the planes

    @property
    def score(self) -> float:
        """Quality of the fit, 0 to 2."""
        return max(self.level, 0.0) + (0.5 if np.isnan(self.agreement) else self.agreement)

    @property
    def is_sound(self) -> bool:
        """Whether nothing contradicts the poses."""
        return self.level > 0.8 and not self.agreement < 0.75 and self.bounce < 0.3

    @property
    def is_wrong(self) -> bool:
        """Whether the poses cannot be right."""
        return self.level < 0.5 or self.agreement < 0.55


def find_plane(points: NDArray) -> Plane | None:
    """Find the plane that holds most points by RANSAC; None unless it holds 40 % of them."""
    near = points[np.linalg.norm(points, axis=1) < _MAX_DISTANCE]
    if len(near) < 50:
        return None
    rng = np.random.default_rng(0)
    a, b, c = (near[rng.integers(len(near), size=_NUM_PLANES)] for _ in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    offset = (normal * a).sum(1)
    width = 0.03 + 0.015 * np.linalg.norm(near, axis=1)
    fraction = (np.abs(near @ normal.T - offset) < width[:, None]).mean(0)
    best = int(fraction.argmax())
    return Plane(normal[best], float(offset[best])) if fraction[best] > 0.4 else None


# Returns T_map_points (4, 4) without the mistake, and the sensor's position (3,) in the frame of the points.
Undo = Callable[[Scan], tuple[NDArray, NDArray]]


def evaluate(scans: list[Scan], planes: list[Plane | None], undo: Undo) -> Fit:
    """Return how well the scans fit after a mistake was undone."""
    levels, heights, cells = [], [], []
    for scan, plane in zip(scans, planes, strict=True):
        T, position = undo(scan)
        if plane is not None:
            height = float(plane.normal @ position) - plane.offset
            heights.append(abs(height))
            up = float(T[2, :3] @ plane.normal) * np.sign(height)
            levels.append(up if abs(height) > 0.05 else -1.0)  # the sensor would lie in the ground
        near = scan.points[np.linalg.norm(scan.points - position, axis=1) < _MAX_DISTANCE]
        cells.append(average_cells(near @ T[:3, :3].T + T[:3, 3]))
    if not levels:
        return Fit(np.nan, np.nan, _compare(cells), np.nan)
    return Fit(float(np.median(levels)), min(levels), _compare(cells), float(np.std(heights)))


def average_cells(points: NDArray) -> dict[tuple[int, int], float]:
    """Return the mean height [m] of each cell whose points have nearly the same."""
    keys, inverse = np.unique(np.floor(points[:, :2] / _CELL_SIZE).astype(np.int64), axis=0, return_inverse=True)
    inverse = inverse.ravel()
    number = np.bincount(inverse)
    mean = np.bincount(inverse, points[:, 2]) / np.maximum(number, 1)
    spread = np.sqrt(np.maximum(np.bincount(inverse, points[:, 2] ** 2) / np.maximum(number, 1) - mean**2, 0))
    return {(int(x), int(y)): float(z) for (x, y), z, s in zip(keys, mean, spread, strict=True) if s < _TOLERANCE}


def _compare(cells: list[dict[tuple[int, int], float]]) -> float:
    """Return the fraction of the cells in which the last scan agrees with another one; NaN if they share too few."""
    last = cells[-1]
    agrees = [abs(z - other[key]) < _TOLERANCE for other in cells[:-1] for key, z in last.items() if key in other]
    return float(np.mean(agrees)) if len(agrees) >= MIN_CELLS else np.nan
