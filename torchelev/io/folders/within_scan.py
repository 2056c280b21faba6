"""Take the sensor's motion within a scan of a folder out of its points, by the poses of its path."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.frames import deskew
from torchelev.io.files.arrays import CloudFile
from torchelev.io.notes import Note
from torchelev.io.points.times import describe_times, longest_scan, to_seconds

_MAX_GAP = 1.0  # [s] between poses, between which the motion is unknown
_MAX_OUTSIDE = 0.2  # [s] by which points may be older than the first pose or younger than the last
_SORTED = 0.9  # of the steps of a column of times go forward; lidars write ring after ring, or column after column
_NO_CLOCK = "the points have times, the poses have none, so that the motion within a scan stays in it"


class SensorPath(NamedTuple):
    """The sensor's path, and its clock."""

    times: NDArray[np.float64]  #: (K,) [s] increasing
    T_map_sensor: NDArray[np.float64]  #: (K, 4, 4)
    period: float | None  #: [s] between two scans; None: unknown


def hold_still(
    cloud: CloudFile, path: SensorPath | None, stamp: float, at: float
) -> tuple[NDArray[np.float32], tuple[Note, ...]]:
    """Return the points (N, 3) [m] as seen at one instant, and what is not used of the cloud.

    Args:
        cloud: the scan.
        path: of the sensor; None: there are no times of poses.
        stamp: [s] from which the scan's times count, by the clock of the path.
        at: [s] the instant.
    """
    name, raw = (cloud.time_name, cloud.times) if cloud.times is not None else _find_times(cloud, path, stamp)
    if raw is None or not len(raw):
        return cloud.points, ()
    is_hit = np.isfinite(cloud.points).all(1) & cloud.points.any(1)
    period = None if path is None else path.period
    if path is None:
        is_constant = not is_hit.any() or np.ptp(raw[is_hit]) == 0
        note = Note(f"{_NO_CLOCK}; give poses as TUM, with times, or --dt", "no clock")
        return cloud.points, () if is_constant else (note,)
    times = to_seconds(raw, stamp, period, is_hit)
    said = describe_times(name, raw, times, stamp, period, is_hit)
    notes = () if said is None else (said,)
    if times is None:
        return cloud.points, notes
    points = _deskew(cloud.points, times, path, stamp, at)
    if points is None:
        return cloud.points, (*notes, Note("too few poses within a scan to take its motion out", "few poses"))
    return points, notes


def _deskew(
    points: NDArray[np.float32], times: NDArray, path: SensorPath, stamp: float, at: float
) -> NDArray[np.float32] | None:
    """Return the points at the instant; None if there is no pose near."""
    finite = times[np.isfinite(times)]
    if not finite.size:
        return points
    first, last = stamp + min(finite.min(), 0.0), stamp + max(finite.max(), 0.0)
    begin = max(int(np.searchsorted(path.times, min(first, at), "right")) - 1, 0)
    end = min(int(np.searchsorted(path.times, max(last, at), "left")) + 1, len(path.times))
    begin, end = max(0, min(begin, end - 2)), max(end, min(begin + 2, len(path.times)))
    stamps = path.times[begin:end]
    if len(stamps) < 2 or np.diff(stamps).max() > _MAX_GAP:
        return None
    given = points, times, path.T_map_sensor[begin:end], stamps - stamp
    cloud, at_times, T, known = (torch.from_numpy(np.ascontiguousarray(value))[None] for value in given)
    instant = torch.tensor([at - stamp], dtype=torch.float64)
    return deskew(cloud, at_times, T, known, instant, _MAX_OUTSIDE)[0].numpy()


def _find_times(cloud: CloudFile, path: SensorPath | None, stamp: float) -> tuple[str, NDArray | None]:
    """Return the column without a name that can only hold times, and what to call it; None if there is none."""
    if cloud.others is None or path is None:
        return "", None
    is_hit = np.isfinite(cloud.points).all(1) & cloud.points.any(1)
    for column in range(cloud.others.shape[1]):
        raw = cloud.others[:, column]
        if _is_time(raw[is_hit].astype(np.float64), path.period, stamp):
            return f"{column + 4}", raw
    return "", None


def _is_time(values: NDArray[np.float64], period: float | None, stamp: float) -> bool:
    """Return whether a column is one of seconds: it fills the period and goes forward, unlike intensity or ring."""
    if len(values) < 2 or period is None or not np.isfinite(values).all():
        return False
    away = stamp if values.min() > 1e8 else 0.0
    first, last = values.min() - away, values.max() - away
    fills = 0.5 * period <= last - first <= longest_scan(period) and abs(first) <= longest_scan(period)
    return bool(fills and np.mean(np.diff(values) >= 0) >= _SORTED)
