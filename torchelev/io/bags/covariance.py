"""The covariance of poses that odometry gives."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.scans import stamp_of

_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
# Drivers say "not measured" by variances such as 1e6 or 1e12: no position is that bad, and no rotation exceeds pi.
_UNKNOWN = np.array([1e3] * 3 + [np.pi**2] * 3)  # [m^2], [rad^2]


class PoseCovariances:
    """The covariances of the base's pose over a recording: of x, y, z and the rotations about the map's axes.

    Args:
        topic: of the odometry, for notes.
    """

    def __init__(self, topic: str = "") -> None:
        self._topic = topic
        self._stamps: list[float] = []
        self._values: list[NDArray[np.float64]] = []
        self._order: tuple[NDArray[np.float64], NDArray[np.int64]] | None = None  # sorted stamps, and where they were
        self._unknown: dict[str, float] = {}  # largest variance of each axis that was not measured

    def add(self, message: Any, stamp: float | None = None) -> None:
        """Add the covariance of a nav_msgs/Odometry; one that is not filled in (all zeros, or not finite) is left out.

        Variances above 1000 m^2 or pi^2 mean "not measured": these axes count as known, see `notes`.
        """
        value = np.asarray(message.pose.covariance, dtype=np.float64).reshape(6, 6)
        if not (np.isfinite(value).all() and value.any()):
            return
        value = self._drop_unknown((value + value.T) / 2)
        if value.any() and np.linalg.eigvalsh(value).min() >= 0:
            self._stamps.append(stamp_of(message.header) if stamp is None else stamp)
            self._values.append(value)

    @property
    def notes(self) -> list[str]:
        """A sentence on variances that were not measured."""
        if not self._unknown:
            return []
        axes, largest = ", ".join(self._unknown), max(self._unknown.values())
        return [f"{self._topic} gives variances up to {largest:.0e} for {axes}: not measured, and taken as 0"]

    def _drop_unknown(self, value: NDArray[np.float64]) -> NDArray[np.float64]:
        unknown = np.diag(value) >= _UNKNOWN
        for axis in np.flatnonzero(unknown):
            name, variance = _AXES[axis], float(value[axis, axis])
            self._unknown[name] = max(variance, self._unknown.get(name, 0.0))
        return np.where(unknown[:, None] | unknown, 0.0, value)

    def of_sensor(self, time: float, lever: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the covariance (6, 6) of a sensor's pose at a time [s]; None if none is known.

        With the lever r (3,) [m], from the base to the sensor in the map's axes, an error d_theta of the base's
        rotation moves the sensor by d_theta x r.
        """
        if not self._stamps:
            return None
        x, y, z = lever
        A = np.eye(6)
        A[:3, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
        return A @ self._values[self._nearest(time)] @ A.T

    def _nearest(self, time: float) -> int:
        """Return which covariance is nearest to a time [s]; their stamps are sorted once."""
        if self._order is None or len(self._order[0]) != len(self._stamps):
            stamps = np.array(self._stamps)
            order = np.argsort(stamps, kind="stable")
            self._order = stamps[order], order
        stamps, order = self._order
        after = int(np.clip(np.searchsorted(stamps, time), 1, max(len(stamps) - 1, 1)))
        is_before = len(stamps) == 1 or time - stamps[after - 1] <= stamps[after] - time
        return int(order[after - 1 if is_before else after])
