"""Common mistakes that would explain poses that do not fit their points: each is undone, and the fits are compared."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from torchelev.diagnosis.scan_fit import Fit, Scan, Undo, evaluate, find_plane
from torchelev.frames.axes import CAMERA_AXES
from torchelev.frames.quaternions import to_quaternion, to_rotation

_TILTED, _LEVEL = np.cos(np.radians([8.0, 1.5]))  # cosines of the ground's tilt
_OPTICAL = CAMERA_AXES["optical"]  # takes x right, y down, z forward to x forward, y left, z up


def _compose(rotation: NDArray, position: NDArray) -> NDArray:
    """Return the pose (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, position
    return T


def _keep(scan: Scan) -> tuple[NDArray, NDArray]:
    return scan.T, np.zeros(3)


def _keep_in_map(scan: Scan) -> tuple[NDArray, NDArray]:
    return np.eye(4), scan.T[:3, 3]


def _invert(scan: Scan) -> tuple[NDArray, NDArray]:
    R = scan.T[:3, :3].T
    return _compose(R, -R @ scan.T[:3, 3]), np.zeros(3)


def _correct(correct: Callable[[NDArray], NDArray]) -> Undo:
    """Undo a mistake in the rotation."""
    return lambda scan: (_compose(correct(scan.T[:3, :3]), scan.T[:3, 3]), np.zeros(3))


def _correct_base(correct: Callable[[NDArray], NDArray]) -> Undo:
    """Undo a mistake in the rotation of the base, on which the sensor is mounted as the poses say."""

    def undo(scan: Scan) -> tuple[NDArray, NDArray]:
        if scan.base is None or not np.isfinite(scan.base).all():
            return _keep(scan)
        T_map_base = _compose(correct(scan.base[:3, :3]), scan.base[:3, 3])
        return T_map_base @ np.linalg.inv(scan.base) @ scan.T, np.zeros(3)

    return undo


def _correct_mounting(correct: Callable[[NDArray], NDArray]) -> Undo:
    """Undo a mistake in the sensor's rotation on its base."""

    def undo(scan: Scan) -> tuple[NDArray, NDArray]:
        if scan.base is None or not np.isfinite(scan.base).all():
            return _keep(scan)
        R_map_base = scan.base[:3, :3]
        return _compose(R_map_base @ correct(R_map_base.T @ scan.T[:3, :3]), scan.T[:3, 3]), np.zeros(3)

    return undo


def _halve(R: NDArray) -> NDArray:
    """Return the rotation that gives R when it is applied twice."""
    q = to_quaternion(R)
    q = (q if q[0] >= 0 else -q) + [1.0, 0.0, 0.0, 0.0]
    return to_rotation(q / np.linalg.norm(q))


def _reorder(shift: int) -> Callable[[NDArray], NDArray]:
    """Return the correction of a rotation whose quaternion (w, x, y, z) was shifted: 1 moves its last entry to w."""
    return lambda R: to_rotation(np.roll(to_quaternion(R), shift))


# The sentence of each mistake, and how to undo it.
_MISTAKES: dict[str, Undo] = {
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
    "reorder it": _correct(_reorder(1)),
    "a quaternion in the order w x y z was read as x y z w: "
    "reorder it": _correct(_reorder(-1)),
}  # fmt: skip
_MOUNTING_MISTAKES: dict[str, Undo] = {
    "the sensor's mounting is applied twice, as the points have the axes of the base already: "
    "give the points in the sensor's axes, or a pose with the rotation of T_map_base": _correct_mounting(
        lambda R: np.eye(3)
    ),
    "the rotation of the sensor's mounting is applied twice in T_map_sensor: "
    "multiply T_map_base by it once": _correct_mounting(_halve),
}  # fmt: skip
_BASE_MISTAKES: dict[str, Undo] = {
    "the base's quaternion, in the order x y z w, was read as w x y z, and T_map_sensor follows from it: "
    "reorder it": _correct_base(_reorder(1)),
    "the base's quaternion, in the order w x y z, was read as x y z w, and T_map_sensor follows from it: "
    "reorder it": _correct_base(_reorder(-1)),
}  # fmt: skip


def explain(scans: list[Scan]) -> tuple[Fit, list[str]]:
    """Return how well the scans fit and, if they do not, the mistakes that would explain it."""
    planes = [find_plane(scan.points) for scan in scans]
    given = evaluate(scans, planes, _keep)
    mistakes = _MISTAKES if given.is_wrong else {}
    if not (given.is_sound and given.lowest > 0.8):  # a base tilts as it turns, so that most scans may still fit
        mistakes = mistakes | _MOUNTING_MISTAKES | _BASE_MISTAKES
    fits = {name: evaluate(scans, planes, undo) for name, undo in mistakes.items()}
    sound = {name: f for name, f in fits.items() if f.is_sound and f.score > given.score + 0.25}
    if not sound and given.level < _TILTED and _is_still_and_level(scans):
        fits = {name: evaluate(scans, planes, undo) for name, undo in _MOUNTING_MISTAKES.items()}
        sound = {name: f for name, f in fits.items() if f.is_sound and f.lowest > _LEVEL}
    best = max((f.score for f in sound.values()), default=0.0)
    return given, [name for name, f in sound.items() if f.score > best - 0.02]


def _is_still_and_level(scans: list[Scan]) -> bool:
    """Return whether the robot stands, upright: a ground that is tilted as its sensor is then has no other trace."""
    bases = [scan.base for scan in scans if scan.base is not None]
    if len(bases) < len(scans) or min(T[2, 2] for T in bases) < _LEVEL:
        return False
    return float(np.ptp([T[:3, 3] for T in bases], axis=0).max()) < 0.2
