"""Points and their times out of a LaserScan."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from torchelev.io.bags.messages.cloud import Cloud, Note
from torchelev.io.points.times import longest_scan

_SMALLER = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # units in which drivers give a time_increment that ROS wants in s
_SHORTEST = 0.1  # of a period: how long a scan in such a unit takes at least


def read_laser_scan(message: Any, period: float | None = None) -> Cloud:
    """Return the points of a sensor_msgs/LaserScan, NaN where there is no return.

    Args:
        message: the message.
        period: [s] between two messages; a scan takes no longer. None: unknown.
    """
    ranges = np.asarray(message.ranges, dtype=np.float64)
    number = np.arange(len(ranges), dtype=np.float64)
    angle = message.angle_min + message.angle_increment * number
    valid = (ranges >= message.range_min) & (ranges <= message.range_max)
    distance = np.where(valid, ranges, np.nan)
    points = np.stack([distance * np.cos(angle), distance * np.sin(angle), 0 * distance], -1).astype(np.float32)
    step, note = _time_step(float(message.time_increment), len(ranges), period)
    return Cloud(points, step * number if step > 0 else None, () if note is None else (note,))


def _time_step(increment: float, num_rays: int, period: float | None) -> tuple[float, Note | None]:
    """Return the time between two rays [s], 0 if it is unknown, and a note if it is implausible."""
    duration, limit = increment * (num_rays - 1), longest_scan(period)
    if not duration > 0 or duration <= limit:
        return (increment if duration > 0 else 0.0), None
    odd = f"time_increment is {increment:.6g}: {num_rays} rays would take {duration:.3g} s, but"
    odd += " a scan takes 2 s at most" if period is None else f" scans come every {period:.3g} s"
    if period is not None and math.isfinite(duration):
        for name, unit in _SMALLER.items():
            if _SHORTEST * period <= duration * unit <= limit:
                return increment * unit, Note(f"{odd}; it is taken as {name}", "time_increment")
    return 0.0, Note(f"{odd}; it is not used", "time_increment")
