"""Clouds in the messages of Livox's own drivers, as FAST-LIO needs them."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchelev.io.bags.messages.cloud import Cloud

LIVOX = tuple(f"{package}/msg/CustomMsg" for package in ("livox_ros_driver2", "livox_ros_driver", "livox_interfaces"))
_NEAR = 2.0  # [s] by which `timebase` may differ from the stamp


def read_livox(message: Any, stamp: float) -> Cloud:
    """Return the points of a CustomMsg, with `offset_time` [ns] from `timebase` [ns]; no return lies at 0, 0, 0.

    The stamp takes the place of a `timebase` by another clock: drivers give both the time of the first point.
    """
    num = len(message.points)
    rows = [(point.x, point.y, point.z, point.offset_time) for point in message.points]
    table = np.array(rows, dtype=np.float64).reshape(num, 4)
    points = table[:, :3].astype(np.float32)
    points[~(points != 0).any(1)] = np.nan
    start = float(np.longdouble(message.timebase) * np.longdouble(1e-9) - np.longdouble(stamp))
    times = table[:, 3] * 1e-9 + (start if abs(start) <= _NEAR else 0.0)
    return Cloud(points, times if num and np.ptp(times) > 0 else None)
