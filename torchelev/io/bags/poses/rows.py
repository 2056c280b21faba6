"""Poses of one frame in another as rows of numbers.

A row holds the stamp [s], x, y, z [m], the quaternion x, y, z, w, and when it was recorded [s].
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.frames import transform_xyzw

WIDTH = 9  # numbers in a row
_SAME = 1e-5  # [m], and of a unit quaternion: a pose that changes by less stays the same


def is_constant(rows: NDArray[np.float64]) -> bool:
    """Return whether the poses (K, 9) are all the same, to rounding."""
    signs = np.where(rows[:, 4:8] @ rows[0, 4:8] < 0, -1.0, 1.0)  # q and -q are one rotation
    turned = rows[:, 4:8] * signs[:, None]
    return bool(np.ptp(rows[:, 1:4], axis=0).max() < _SAME and np.ptp(turned, axis=0).max() < _SAME)


def describe_gap(frame: str, parent: str, stamps: NDArray[np.float64], max_gap: float) -> str:
    """Return a sentence on the pauses between poses that are longer than a time [s]; "" if there is none."""
    gaps = np.diff(stamps)
    if not (gaps > max_gap).any():
        return ""
    longest, more = int(gaps.argmax()), int((gaps > max_gap).sum()) - 1
    return (
        f"{frame} has no pose in {parent} for {gaps[longest]:.1f} s, from {stamps[longest] - stamps[0]:.1f} s after "
        f"its first (stamp {stamps[longest]:.3f})"
        + (f", and {more} more" if more else "")
        + ": scans there have interpolated poses"
    )


def invert(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Invert rigid transforms (..., 4, 4)."""
    inverse = np.zeros_like(T)
    rotation = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse[..., :3, :3], inverse[..., 3, 3] = rotation, T[..., 3, 3]
    inverse[..., :3, 3] = -(rotation @ T[..., :3, 3, None])[..., 0]
    return inverse


def pose_numbers(position: Any, orientation: Any) -> list[float]:
    """Return x, y, z and the quaternion x, y, z, w of two messages."""
    place, turn = [getattr(position, name) for name in "xyz"], [getattr(orientation, name) for name in "xyzw"]
    return [float(value) for value in (*place, *turn)]


def to_matrices(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the poses (K, 4, 4) of rows (K, 9)."""
    quaternions = rows[:, 4:8] / np.linalg.norm(rows[:, 4:8], axis=1, keepdims=True)
    return transform_xyzw(rows[:, 1:4], quaternions).numpy()


def from_matrix(T: NDArray[np.float64]) -> list[float]:
    """Return x, y, z and the quaternion x, y, z, w of a pose (4, 4).

    The quaternion is the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix; no rotation makes it singular.
    """
    R = T[:3, :3]
    v = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    K = np.zeros((4, 4))
    K[:3, :3] = R + R.T - np.trace(R) * np.eye(3)
    K[3, :3] = K[:3, 3] = v
    K[3, 3] = np.trace(R)
    return [*T[:3, 3].tolist(), *np.linalg.eigh(K)[1][:, -1].tolist()]
