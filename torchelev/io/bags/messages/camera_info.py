"""The intrinsic matrix of a depth image out of its CameraInfo."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.messages.cloud import CloudError, Note

_DISTORTED = 1e-3  # largest coefficient of a lens that is taken as without distortion


def choose_matrix(camera: Any, topic: str = "") -> tuple[NDArray[np.float64], Note | None]:
    """Return the intrinsic matrix of a depth image: that of P where it is filled in, else K.

    ROS's own converters take depth images as rectified, whose matrix is P. Some drivers fill in only one of the two.

    Args:
        camera: a sensor_msgs/CameraInfo.
        topic: of the images: one with "rect" in its name holds rectified images, if there is a P.

    Returns:
        The matrix (3, 3) [pixels], and a note if the CameraInfo has a distortion that is not applied.

    Raises:
        CloudError: neither P nor K is filled in.
    """
    P, K = _numbers(camera, "p", 12).reshape(3, 4)[:, :3], _numbers(camera, "k", 9).reshape(3, 3)
    matrix = next((matrix for matrix in (P, K) if _is_calibrated(matrix)), None)
    if matrix is None:
        raise CloudError("the CameraInfo holds no calibration: the focal lengths of both P and K are not positive")
    distortion = np.abs(_numbers(camera, "d", 0))
    if not (distortion > _DISTORTED).any() or (matrix is P and "rect" in topic):
        return matrix, None
    text = f"the CameraInfo has a distortion, coefficients up to {distortion.max():.3g}, which is not applied"
    return matrix, Note(
        f"{text}: depth images are taken as rectified; give the topic of rectified images", "distortion"
    )


def _numbers(camera: Any, name: str, num: int) -> NDArray[np.float64]:
    """Return an array of ROS 1 or ROS 2, which write it large and small; zeros where it is missing."""
    values = np.asarray(getattr(camera, name.upper(), getattr(camera, name, ())), dtype=np.float64).ravel()
    return values if len(values) == num or not num else np.zeros(num)


def _is_calibrated(matrix: NDArray[np.float64]) -> bool:
    return bool(np.isfinite(matrix).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0)
