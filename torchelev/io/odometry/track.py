"""Poses of a lidar from its clouds alone, by KISS-ICP (Vizzo et al., RA-L 2023; package kiss-icp).

KISS-ICP's own interface normalises the times of a scan's points to 0..1, gives the pose of the last point, and does not
say when that was. Here each scan is first taken to the middle of its points' times, by the motion of the two poses
before: an error of this motion moves the first half of a scan as far forwards as the second half backwards, and leaves
the pose alone. Taken to its first point it would feed on itself.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.frames import deskew, interpolate_poses
from torchelev.io.odometry.health import Health, OdometryError

_VOXELS = 40.0  # across the reach of a scan
_VOXEL = (0.2, 1.0)  # [m] smallest and largest
_RANGE = 100.0  # [voxels] of KISS-ICP's local map, as by its own default
_MIN_POINTS = 100
_MAX_GAP = 1.0  # [s] over which the motion is extrapolated


class Sweep(NamedTuple):
    """A scan of a lidar."""

    stamp: float  #: [s] of its message
    points: NDArray[np.float32]  #: (N, 3) [m] sensor frame; NaN where there is no return
    times: NDArray[np.float64] | None  #: (N,) [s] of each point from the stamp; None: all at once


class Track(NamedTuple):
    """Poses of a sensor."""

    times: NDArray[np.float64]  #: (K,) [s] of the poses, increasing: the middle of each scan
    stamps: NDArray[np.float64]  #: (K,) [s] of the scans' messages
    T_start_sensor: NDArray[np.float64]  #: (K, 4, 4) in the sensor's frame at the first pose
    nearby: NDArray[np.float64]  #: (M, 3) [m] points of the first scans, in the same frame
    skipped: Counter[str]  #: number of scans that were left out, by reason

    def at(self, times: NDArray[np.float64], max_extrapolation: float = 1.0) -> NDArray[np.float64]:
        """Return the poses (M, 4, 4) at times (M,) [s], as `interpolate_poses` finds them."""
        start = self.times[0]
        given = self.T_start_sensor, self.times - start, np.asarray(times, dtype=np.float64) - start
        poses, stamps, asked = (torch.from_numpy(value)[None] for value in given)
        return interpolate_poses(poses, stamps, asked, max_extrapolation)[0].numpy()


class LidarOdometry:
    """Finds the pose of one scan after the other.

    Raises:
        ModuleNotFoundError: kiss-icp is missing.
    """

    def __init__(self) -> None:
        from kiss_icp.config import load_config

        self._config = load_config(None)
        self._icp: Any = None
        self._health = Health(1.0)
        self._times: list[float] = []
        self._stamps: list[float] = []
        self._poses: list[NDArray[np.float64]] = []
        self._nearby: list[NDArray[np.float64]] = []
        self._skipped: Counter[str] = Counter()

    def add(self, sweep: Sweep) -> None:
        """Find the pose of a scan; scans with few points, or older than the one before, are left out and counted.

        Raises:
            OdometryError: the odometry is lost.
        """
        points, times, middle = _clean(sweep)
        if len(points) < _MIN_POINTS:
            self._skipped[f"fewer than {_MIN_POINTS} points"] += 1
            return
        if self._times and middle <= self._times[-1]:
            self._skipped["older than the scan before"] += 1
            return
        if self._icp is None:
            self._start(points)
        expected = self._expect(middle)
        self._icp.last_delta = np.linalg.inv(self._icp.last_pose) @ expected
        frame, _ = self._icp.register_frame(self._still(points, times, middle), np.zeros(0))
        pose = self._icp.last_pose.copy()
        dt = middle - self._times[-1] if self._times else 0.0
        self._health.check(middle - (self._times[0] if self._times else middle), dt, expected, pose, frame)
        if len(self._nearby) < 10:
            self._nearby.append(frame[::4] @ pose[:3, :3].T + pose[:3, 3])
        self._times.append(middle)
        self._stamps.append(sweep.stamp)
        self._poses.append(pose)

    def finish(self) -> Track:
        """Return the poses of all scans.

        Raises:
            OdometryError: there are fewer than two, or the scans do not show how the sensor moves.
        """
        if len(self._poses) < 2:
            why = "".join(f"; {number} were left out: {reason}" for reason, number in self._skipped.items())
            raise OdometryError(f"odometry needs at least two scans, and {len(self._poses)} can be used{why}")
        self._health.finish()
        poses = (np.linalg.inv(self._poses[0]) @ np.array(self._poses)).astype(np.float64)
        return Track(np.array(self._times), np.array(self._stamps), poses, np.concatenate(self._nearby), self._skipped)

    def _start(self, points: NDArray[np.float64]) -> None:
        """Choose the voxels by the reach of the first scan: rooms need smaller ones than fields."""
        from kiss_icp.kiss_icp import KissICP

        reach = float(np.percentile(np.linalg.norm(points, axis=1), 98))
        voxel = float(np.clip(reach / _VOXELS, *_VOXEL))
        self._config.mapping.voxel_size, self._config.data.max_range = voxel, _RANGE * voxel
        self._config.data.deskew = False
        self._icp, self._health = KissICP(self._config), Health(voxel)

    def _recent(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the last two poses (1, 2, 4, 4), and their times (1, 2) [s] from the last one."""
        times = np.array(self._times[-2:]) - self._times[-1]
        return torch.from_numpy(np.array(self._poses[-2:]))[None], torch.from_numpy(times)[None]

    def _expect(self, middle: float) -> NDArray[np.float64]:
        """Return the pose (4, 4) to which the last motion leads; the last one after a pause."""
        if len(self._poses) < 2 or middle - self._times[-1] > _MAX_GAP:
            return self._icp.last_pose.copy()
        poses, times = self._recent()
        asked = torch.tensor([[middle - self._times[-1]]], dtype=torch.float64)
        return interpolate_poses(poses, times, asked, _MAX_GAP)[0, 0].numpy()

    def _still(self, points: NDArray, times: NDArray | None, middle: float) -> NDArray[np.float64]:
        """Return the points as seen at the middle of the scan, if the last motion continues."""
        if times is None or len(self._poses) < 2 or middle - self._times[-1] > _MAX_GAP:
            return points
        poses, stamps = self._recent()
        at = torch.tensor([middle - self._times[-1]], dtype=torch.float64)
        seen, measured = torch.from_numpy(points)[None], torch.from_numpy(times - self._times[-1])[None]
        moved = deskew(seen, measured, poses, stamps, at, 2 * _MAX_GAP)[0].numpy()
        return moved[np.isfinite(moved).all(1)]


def estimate_track(sweeps: Iterable[Sweep]) -> Track:
    """Return the poses of a lidar from its scans, in their order.

    Args:
        sweeps: the scans; read one at a time.

    Raises:
        OdometryError: the odometry is lost, or there are too few scans.
        ModuleNotFoundError: kiss-icp is missing.
    """
    odometry = LidarOdometry()
    for sweep in sweeps:
        odometry.add(sweep)
    return odometry.finish()


def _clean(sweep: Sweep) -> tuple[NDArray[np.float64], NDArray[np.float64] | None, float]:
    """Return the finite points with their times (N,) [s], and the time of the pose [s]."""
    known = np.isfinite(sweep.points).all(1)
    if sweep.times is not None:
        known &= np.isfinite(sweep.times)
    points = sweep.points[known].astype(np.float64)
    if sweep.times is None or not len(points):
        return points, None, sweep.stamp
    times = sweep.times[known]
    return points, sweep.stamp + times, sweep.stamp + float(times.min() + times.max()) / 2
