"""The covariance of poses that odometry gives."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.scans import stamp_of


class PoseCovariances:
    """The covariances of the base's pose over a recording: of x, y, z and the rotations about the map's axes."""

    def __init__(self) -> None:
        self._stamps: list[float] = []
        self._values: list[NDArray[np.float64]] = []

    def add(self, message: Any) -> None:
        """Add that of a nav_msgs/Odometry, unless it is not filled in: all zeros, or not finite."""
        value = np.asarray(message.pose.covariance, dtype=np.float64).reshape(6, 6)
        if np.isfinite(value).all() and value.any() and np.linalg.eigvalsh(value + value.T).min() >= 0:
            self._stamps.append(stamp_of(message.header))
            self._values.append((value + value.T) / 2)

    def of_sensor(self, time: float, lever: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the covariance (6, 6) of a sensor's pose at a time [s]; None if none is known.

        With the lever r (3,) [m], from the base to the sensor in the map's axes, an error d_theta of the base's
        rotation moves the sensor by d_theta x r.
        """
        if not self._stamps:
            return None
        nearest = int(np.abs(np.array(self._stamps) - time).argmin())
        x, y, z = lever
        A = np.eye(6)
        A[:3, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
        return A @ self._values[nearest] @ A.T
