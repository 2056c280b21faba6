"""Unit quaternions (w, x, y, z) and rotations, in NumPy and without PyTorch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


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
