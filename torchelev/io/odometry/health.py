"""Monitor odometry, and stop it where it loses track: its poses would look plausible afterwards."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from torchelev.io.odometry.observability import Surfaces, cube_keys, find_surfaces, measure_shift, measure_support

_WINDOW = 15  # scans that decide
_MIN_SUPPORT = 0.003  # see measure_support; with less, simulated drives were off by more than a tenth of their way
_WARM_UP = 3  # scans before the speed is known
_MAX_ACCELERATION = 50.0  # [m/s^2] of a robot with a lidar
_MAX_TURN = 0.6  # [rad] that a scan may be off from where the turn before leads
_KEPT = 5  # scans that the next one is compared with
_MIN_OVERLAP = 0.4  # of a scan's cubes with those before, over the median
_AVERAGED, _MAX_SHIFT = 10, 0.12  # scans, and [m] of their mean shift against those before; sound drives had 0.06
_INSTEAD = "record wheel or inertial odometry with the bag, and map with its poses"


class OdometryError(ValueError):
    """Poses cannot be found from the clouds. The message says when and why, and what to do instead."""


class Health:
    """Raises OdometryError at the first scan where the odometry is lost.

    Args:
        voxel: [m] side length of the odometry's voxels.
    """

    def __init__(self, voxel: float) -> None:
        self._voxel = voxel
        self._count = 0
        self._supports: deque[float] = deque(maxlen=_WINDOW)
        self._overlaps: deque[float] = deque(maxlen=4 * _WINDOW)
        self._surfaces: deque[Surfaces] = deque(maxlen=_KEPT)
        self._shifts: deque[NDArray[np.float64]] = deque(maxlen=_AVERAGED)
        self._seen: deque[NDArray[np.int64]] = deque(maxlen=_KEPT)

    def check(
        self, time: float, dt: float, expected: NDArray[np.float64], pose: NDArray[np.float64], points: NDArray
    ) -> None:
        """Judge a scan.

        Args:
            time: [s] since the first scan.
            dt: [s] since the previous scan.
            expected: pose (4, 4) to which the motion before leads.
            pose: pose (4, 4) that was found.
            points: [m] finite points (N, 3), taken to the time of the pose, sensor frame.

        Raises:
            OdometryError: the pose is not to be trusted.
        """
        self._count += 1
        self._check_support(time, points)
        if self._count > _WARM_UP:
            self._check_jump(time, dt, np.linalg.inv(expected) @ pose)
        placed = points @ pose[:3, :3].T + pose[:3, 3]
        self._check_shift(time, find_surfaces(placed, 2 * self._voxel), pose[:3, :3])
        self._check_overlap(time, placed)

    def finish(self) -> None:
        """Judge a recording that is shorter than the window."""
        if self._count < _WINDOW:
            self._require_support(0.0)

    def _check_support(self, time: float, points: NDArray) -> None:
        self._supports.append(measure_support(points, 2 * self._voxel))
        if self._count >= _WINDOW:
            self._require_support(time)

    def _require_support(self, time: float) -> None:
        support = float(np.median(self._supports)) if self._supports else 1.0
        if support < _MIN_SUPPORT:
            raise OdometryError(
                f"the clouds do not show how far the sensor moves, {time:.1f} s after the first: their surfaces "
                f"constrain one direction by {support:.4f}, and {_MIN_SUPPORT} are needed; a corridor, a tunnel or "
                f"flat open ground looks the same everywhere; {_INSTEAD}"
            )

    def _check_jump(self, time: float, dt: float, step: NDArray[np.float64]) -> None:
        jump = float(np.linalg.norm(step[:3, 3]))
        turn = float(np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1, 1)))
        if jump > self._voxel + _MAX_ACCELERATION * dt**2 or turn > _MAX_TURN:
            raise OdometryError(
                f"the odometry lost the clouds {time:.1f} s after the first: from one scan to the next its pose jumps "
                f"by {jump:.2f} m and {np.degrees(turn):.0f} degrees against the motion before; fast turns in narrow "
                f"rooms do this; {_INSTEAD}"
            )

    def _check_shift(self, time: float, surfaces: Surfaces, R: NDArray[np.float64]) -> None:
        """Refuse surfaces that move with the sensor: where most points lie on a floor, their rings hold ICP fast."""
        if len(self._surfaces) == _KEPT:
            shift = measure_shift(self._surfaces[0], surfaces)
            if shift is not None:
                self._shifts.append(R.T @ shift)
        self._surfaces.append(surfaces)
        off = float(np.linalg.norm(np.mean(self._shifts, 0))) if len(self._shifts) == _AVERAGED else 0.0
        if off > _MAX_SHIFT:
            raise OdometryError(
                f"the odometry lost the clouds {time:.1f} s after the first: over {_KEPT} scans walls move by "
                f"{off:.2f} m with the sensor, as it follows the pattern of the points on the floor; {_INSTEAD}"
            )

    def _check_overlap(self, time: float, points: NDArray) -> None:
        keys = np.unique(cube_keys(points, 2 * self._voxel))
        if self._seen:
            overlap = float(np.isin(keys, np.concatenate(self._seen)).mean())
            usual = float(np.median(self._overlaps)) if len(self._overlaps) >= _WINDOW else 0.0
            if overlap < _MIN_OVERLAP * usual:
                raise OdometryError(
                    f"the odometry lost the clouds {time:.1f} s after the first: only {100 * overlap:.0f} % of a scan "
                    f"lie where the scans before saw something, and {100 * usual:.0f} % are usual here; {_INSTEAD}"
                )
            self._overlaps.append(overlap)
        self._seen.append(keys)
