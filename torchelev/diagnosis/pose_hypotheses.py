"""Which mistake in the poses or points would explain what a sensor saw: each is undone, and the result compared.

A set of scans fits if the largest plane in each is level, lies below the sensor, and the scans agree where they
overlap.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

TRIALS = 80  # planes tried
CELL = 0.15  # [m] in which scans are compared
REACH = 10.0  # [m] from the sensor
SAME = 0.08  # [m] scans agree in a cell
MIN_CELLS = 40  # to compare scans
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # takes x right, y down, z forward to x forward, z up


@dataclass(frozen=True)
class Scan:
    """One sensor's finite points (n, 3) [m] in its frame, its pose, and the time step it belongs to."""

    points: NDArray  #: (N, 3) [m] sensor frame
    T: NDArray  #: (4, 4) T_map_sensor
    step: int  #: time step that it belongs to


class GroundPlane(NamedTuple):
    """The plane with most points of a scan, in the sensor frame: normal . p = offset."""

    normal: NDArray  #: (3,) unit vector
    offset: float  #: [m] of the plane along its normal
    share: float  #: of the points


class Fit(NamedTuple):
    """How sound a set of scans looks; NaN where nothing tells."""

    level: float  #: cosine between the planes' normals and the vertical, median
    agreement: float  #: share of the common cells in which scans have the same height
    bounce: float  #: [m] standard deviation of the sensor's height over the planes

    @property
    def score(self) -> float:
        """Return 0 to 2."""
        return max(self.level, 0.0) + (0.5 if np.isnan(self.agreement) else self.agreement)

    @property
    def is_sound(self) -> bool:
        """Tell whether nothing speaks against it."""
        return self.level > 0.8 and not self.agreement < 0.75 and self.bounce < 0.3

    @property
    def is_wrong(self) -> bool:
        """Tell whether it cannot be right."""
        return self.level < 0.5 or self.agreement < 0.55


def largest_plane(points: NDArray) -> GroundPlane | None:
    """Find the plane with most points by random triples (RANSAC); None unless it holds 40 % of them."""
    near = points[np.linalg.norm(points, axis=1) < REACH]
    if len(near) < 50:
        return None
    rng = np.random.default_rng(0)
    a, b, c = (near[rng.integers(len(near), size=TRIALS)] for _ in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    offset = (normal * a).sum(1)
    width = 0.03 + 0.015 * np.linalg.norm(near, axis=1)
    shares = (np.abs(near @ normal.T - offset) < width[:, None]).mean(0)
    best = int(shares.argmax())
    return GroundPlane(normal[best], float(offset[best]), float(shares[best])) if shares[best] > 0.4 else None


def fit(scans: list[Scan], planes: list[GroundPlane | None], undo: Callable[[Scan], tuple[NDArray, NDArray]]) -> Fit:
    """Judge the scans after a mistake was undone; `undo` gives the right pose, and the sensor's place in the points."""
    levels, heights, cells = [], [], []
    for scan, plane in zip(scans, planes, strict=True):
        T, place = undo(scan)
        if plane is not None:
            height = float(plane.normal @ place) - plane.offset
            heights.append(abs(height))
            up = float(T[2, :3] @ plane.normal) * np.sign(height)
            levels.append(up if abs(height) > 0.05 else -1.0)  # a sensor within the ground
        near = scan.points[np.linalg.norm(scan.points - place, axis=1) < REACH]
        cells.append(_heights(near @ T[:3, :3].T + T[:3, 3], scan.step))
    level, bounce = (float(np.median(levels)), float(np.std(heights))) if levels else (np.nan, np.nan)
    return Fit(level, _agreement(cells), bounce)


def _heights(points: NDArray, step: int) -> dict[tuple[int, int], float]:
    """Return the mean height of each cell that holds points of a small spread."""
    keys, inverse = np.unique(np.floor(points[:, :2] / CELL).astype(np.int64), axis=0, return_inverse=True)
    inverse = inverse.ravel()
    number = np.bincount(inverse)
    mean = np.bincount(inverse, points[:, 2]) / np.maximum(number, 1)
    spread = np.sqrt(np.maximum(np.bincount(inverse, points[:, 2] ** 2) / np.maximum(number, 1) - mean**2, 0))
    return {(int(x), int(y)): float(z) for (x, y), z, s in zip(keys, mean, spread, strict=True) if s < SAME}


def _agreement(cells: list[dict[tuple[int, int], float]]) -> float:
    last = cells[-1]
    same = [abs(z - other[key]) < SAME for other in cells[:-1] for key, z in last.items() if key in other]
    return float(np.mean(same)) if len(same) >= MIN_CELLS else np.nan


def rigid(rotation: NDArray, position: NDArray) -> NDArray:
    """Compose a pose (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, position
    return T


def quaternion(R: NDArray) -> NDArray:
    """Return the unit quaternion (w, x, y, z) of a rotation: the eigenvector of Bar-Itzhack's matrix."""
    K = np.array([
        [np.trace(R), R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
        [0, R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
        [0, 0, R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1]],
        [0, 0, 0, R[2, 2] - R[0, 0] - R[1, 1]],
    ])  # fmt: skip
    return np.linalg.eigh(K, UPLO="U")[1][:, -1]


def rotation(q: NDArray) -> NDArray:
    """Return the rotation of a unit quaternion (w, x, y, z)."""
    w, (x, y, z) = q[0], q[1:]
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * skew + 2 * skew @ skew


def _turned(turn: Callable[[NDArray], NDArray]) -> Callable[[Scan], tuple[NDArray, NDArray]]:
    return lambda scan: (rigid(turn(scan.T[:3, :3]), scan.T[:3, 3]), np.zeros(3))


def as_given(scan: Scan) -> tuple[NDArray, NDArray]:
    """Return the pose as it is."""
    return scan.T, np.zeros(3)


def in_map_already(scan: Scan) -> tuple[NDArray, NDArray]:
    """Leave the points where they are."""
    return np.eye(4), scan.T[:3, 3]


def inverted(scan: Scan) -> tuple[NDArray, NDArray]:
    """Turn the pose round."""
    R = scan.T[:3, :3].T
    return rigid(R, -R @ scan.T[:3, 3]), np.zeros(3)


# What to say, and how to undo it.
MISTAKES: dict[str, Callable[[Scan], tuple[NDArray, NDArray]]] = {
    "the points are in the map frame already, so that the pose is applied twice: "
    "give sensor-frame points, or the transform from the points' frame": in_map_already,
    "T_map_sensor is inverted: give its inverse, which takes sensor-frame points into the map frame": inverted,
    "the rotation in T_map_sensor is transposed: transpose it, and keep the position": _turned(lambda R: R.T),
    "the points have optical axes (x right, y down, z forward), the pose has z up: "
    "multiply the pose by the rotation from optical axes": _turned(lambda R: R @ OPTICAL),
    "the pose has optical axes (z forward), the points have z up: "
    "multiply the pose by the inverse of the rotation from optical axes": _turned(lambda R: R @ OPTICAL.T),
    "the sensor is mounted upside down, which T_map_sensor does not say: "
    "multiply it by diag(1, -1, -1, 1)": _turned(lambda R: R * [1.0, -1.0, -1.0]),
    "a quaternion in the order x y z w was read as w x y z: "
    "reorder it": _turned(lambda R: rotation(np.roll(quaternion(R), 1))),
    "a quaternion in the order w x y z was read as x y z w: "
    "reorder it": _turned(lambda R: rotation(np.roll(quaternion(R), -1))),
}  # fmt: skip


def explain(scans: list[Scan]) -> tuple[Fit, list[str]]:
    """Judge the scans as they are, and name the mistakes that explain them, where they cannot be right."""
    planes = [largest_plane(scan.points) for scan in scans]
    given = fit(scans, planes, as_given)
    if not given.is_wrong:
        return given, []
    fits = {name: fit(scans, planes, undo) for name, undo in MISTAKES.items()}
    sound = {name: f for name, f in fits.items() if f.is_sound and f.score > given.score + 0.25}
    best = max((f.score for f in sound.values()), default=0.0)
    return given, [name for name, f in sound.items() if f.score > best - 0.02]
