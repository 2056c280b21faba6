"""Recorded instants as a binary stream, which `examples/loop.cpp` maps."""

from __future__ import annotations

from typing import Any, BinaryIO

import numpy as np

from torchelev.errors import require

# little-endian, as the C struct `Head`
HEAD = np.dtype([("dt", "<f8"), ("T_map_base", "<f8", (4, 4)), ("num_sensors", "<i4"), ("num_points", "<i4")])


def write_instant(file: BinaryIO, points: Any, T_map_sensor: Any, T_map_base: Any, dt: float) -> None:
    """Append one instant: points (S, N, 3) [m], poses (S, 4, 4) and (4, 4), and `dt` [s].

    Raises:
        ValueError: the sizes do not fit each other.
    """
    points, poses = np.ascontiguousarray(points, "<f4"), np.ascontiguousarray(T_map_sensor, "<f8")
    fits = points.ndim == 3 and points.shape[2] == 3 and poses.shape == (len(points), 4, 4)
    actual = f"{points.shape} and {poses.shape}"
    require(fits, "points, T_map_sensor", "expected (S, N, 3) and (S, 4, 4)", actual, "give one pose per sensor")
    head = np.zeros((), HEAD)
    head["dt"], head["T_map_base"] = dt, T_map_base
    head["num_sensors"], head["num_points"] = points.shape[:2]
    for part in (head, poses, points):
        file.write(part.tobytes())
