"""When the scans of a folder and their poses were taken."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.folders.pairing import Pairing
from torchelev.io.folders.within_scan import SensorPath


class ScanClock(NamedTuple):
    """When the scans and their poses were taken."""

    path: SensorPath  #: of the sensor, by the times of its poses
    stamps: NDArray[np.float64]  #: (T,) [s] from which the times of a scan's points count
    pose_times: NDArray[np.float64]  #: (T,) [s] of the pose that a scan takes

    def part(self, index: slice) -> ScanClock:
        """Return the clock of some of the scans."""
        return self._replace(stamps=self.stamps[index], pose_times=self.pose_times[index])

    def apply_mount(self, T_base_sensor: NDArray[np.float64]) -> ScanClock:
        """Return the clock with the path of a sensor at T_base_sensor (4, 4) on what moved along this one."""
        path = self.path._replace(T_map_sensor=self.path.T_map_sensor @ T_base_sensor)
        return self._replace(path=path)


def find_clock(
    pairing: Pairing, times: NDArray | None, T_map_sensor: NDArray, steps: NDArray, dt: float | None
) -> ScanClock | None:
    """Return when scans and poses were taken: by the poses' times, by the scans' names, or by `dt`; None: unknown."""
    stamps, pose_times = pairing.stamps, times
    if times is None:
        stamps = np.cumsum(steps) if dt else stamps
        pose_times, T_map_sensor = stamps, T_map_sensor[pairing.poses]
    if stamps is None or pose_times is None or len(np.unique(pose_times)) < 2:
        return None
    unique, first = np.unique(pose_times, return_index=True)
    forward = steps[steps > 0]
    period = float(np.median(forward)) if len(forward) else None
    taken = stamps if times is None else times[pairing.poses]
    return ScanClock(SensorPath(unique, T_map_sensor[first], period), stamps, taken)
