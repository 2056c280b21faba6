"""Which usual mistake would explain poses that do not fit their points: each is undone, and the fit compared.

Scans fit if the largest plane in each is level and lies below the sensor, and if they agree where they overlap.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.frames.camera_axes import CAMERA_AXES

_NUM_PLANES = 80  # random planes per scan (RANSAC)
_MAX_DISTANCE = 10.0  # [m] of the points from their sensor
_CELL_SIZE = 0.15  # [m] of the cells in which scans are compared
_TOLERANCE = 0.08  # [m] within which scans agree in a cell
_MIN_CELLS = 40  # cells that a comparison of scans must rest on
_OPTICAL = CAMERA_AXES["optical"]  # takes x right, y down, z forward to x forward, y left, z up


@dataclass(frozen=True)
class Scan:
    """One sensor's finite points in one update, and its pose."""

    points: NDArray  #: (n, 3) [m] sensor frame
    T: NDArray  #: (4, 4) T_map_sensor
    step: int  #: index of the update


class _Plane(NamedTuple):
    """The plane that holds most points of a scan, in the sensor frame: normal . p = offset."""

    normal: NDArray  #: (3,) unit vector
    offset: float  #: [m] from the sensor, along the normal


class Fit(NamedTuple):
    """How well scans fit together; NaN where they do not show it."""

    level: float  #: median cosine between the planes' normals and the vertical
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


def _find_plane(points: NDArray) -> _Plane | None:
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
    return _Plane(normal[best], float(offset[best])) if fraction[best] > 0.4 else None


# Returns T_map_points (4, 4) without the mistake, and the sensor's position (3,) in the frame of the points.
_Undo = Callable[[Scan], tuple[NDArray, NDArray]]


def _evaluate(scans: list[Scan], planes: list[_Plane | None], undo: _Undo) -> Fit:
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
        cells.append(_average_cells(near @ T[:3, :3].T + T[:3, 3]))
    level, bounce = (float(np.median(levels)), float(np.std(heights))) if levels else (np.nan, np.nan)
    return Fit(level, _compare(cells), bounce)


def _average_cells(points: NDArray) -> dict[tuple[int, int], float]:
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
    return float(np.mean(agrees)) if len(agrees) >= _MIN_CELLS else np.nan


def _compose(rotation: NDArray, position: NDArray) -> NDArray:
    """Return the pose (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, position
    return T


def to_quaternion(R: NDArray) -> NDArray:
    """Return the unit quaternion (w, x, y, z) of a rotation (Bar-Itzhack, 2000)."""
    K = np.array([
        [np.trace(R), R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
        [0, R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
        [0, 0, R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1]],
        [0, 0, 0, R[2, 2] - R[0, 0] - R[1, 1]],
    ])  # fmt: skip
    return np.linalg.eigh(K, UPLO="U")[1][:, -1]


def to_rotation(q: NDArray) -> NDArray:
    """Return the rotation of a unit quaternion (w, x, y, z)."""
    w, (x, y, z) = q[0], q[1:]
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * skew + 2 * skew @ skew


def _keep(scan: Scan) -> tuple[NDArray, NDArray]:
    return scan.T, np.zeros(3)


def _keep_in_map(scan: Scan) -> tuple[NDArray, NDArray]:
    return np.eye(4), scan.T[:3, 3]


def _invert(scan: Scan) -> tuple[NDArray, NDArray]:
    R = scan.T[:3, :3].T
    return _compose(R, -R @ scan.T[:3, 3]), np.zeros(3)


def _correct(correct: Callable[[NDArray], NDArray]) -> _Undo:
    """Undo a mistake in the rotation."""
    return lambda scan: (_compose(correct(scan.T[:3, :3]), scan.T[:3, 3]), np.zeros(3))


# The sentence of each mistake, and how to undo it.
_MISTAKES: dict[str, _Undo] = {
    "the points are in the map frame already, so that the pose is applied twice: "
    "give sensor-frame points, or the transform from the points' frame": _keep_in_map,
    "T_map_sensor is inverted: give its inverse, which takes sensor-frame points into the map frame": _invert,
    "the rotation in T_map_sensor is transposed: transpose it, and keep the position": _correct(lambda R: R.T),
    "the points have optical axes (x right, y down, z forward), the pose has z up: "
    "multiply the pose by the rotation from optical axes": _correct(lambda R: R @ _OPTICAL),
    "the pose has optical axes (z forward), the points have z up: "
    "multiply the pose by the inverse of the rotation from optical axes": _correct(lambda R: R @ _OPTICAL.T),
    "the sensor is mounted upside down, which T_map_sensor does not say: "
    "multiply it by diag(1, -1, -1, 1)": _correct(lambda R: R * [1.0, -1.0, -1.0]),
    "a quaternion in the order x y z w was read as w x y z: "
    "reorder it": _correct(lambda R: to_rotation(np.roll(to_quaternion(R), 1))),
    "a quaternion in the order w x y z was read as x y z w: "
    "reorder it": _correct(lambda R: to_rotation(np.roll(to_quaternion(R), -1))),
}  # fmt: skip


def explain(scans: list[Scan]) -> tuple[Fit, list[str]]:
    """Return how well the scans fit and, if they cannot be right, the mistakes that would explain it."""
    planes = [_find_plane(scan.points) for scan in scans]
    given = _evaluate(scans, planes, _keep)
    if not given.is_wrong:
        return given, []
    fits = {name: _evaluate(scans, planes, undo) for name, undo in _MISTAKES.items()}
    sound = {name: f for name, f in fits.items() if f.is_sound and f.score > given.score + 0.25}
    best = max((f.score for f in sound.values()), default=0.0)
    return given, [name for name, f in sound.items() if f.score > best - 0.02]
