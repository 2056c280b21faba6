"""Points and their times from a PointCloud2 message with any layout of fields."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.messages.cloud import Cloud, CloudError
from torchelev.io.bags.messages.raw import as_bytes
from torchelev.io.points.colors import color_fields, to_colors
from torchelev.io.points.times import TIME_FIELDS, describe_times, to_seconds

__all__ = ["Cloud", "CloudError", "read_points", "to_seconds"]

# sensor_msgs/PointField
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def read_points(message: Any, stamp: float, period: float | None = None, colors: bool = False) -> Cloud:
    """Return the points of a sensor_msgs/PointCloud2.

    Fields may have any order, padding, byte order and type; rows may be padded, too. Times are a field named t, time,
    timestamp, time_stamp, offset_time, time_offset or ts. Their unit is the one of s, ms, us and ns in which the scan
    takes 2 ms to the period, seconds first for floats and nanoseconds first for integers. They count from the message's
    stamp, or from 1970; those from 0 to 1 are fractions of the period. Only times of finite points count.

    Args:
        message: the message.
        stamp: [s] of its header.
        period: [s] between two messages; None: unknown, a scan takes 2 s at most.
        colors: read the colours of the points, too, if they have any.

    Raises:
        CloudError: x, y or z is missing, the sizes contradict each other, or this is not a PointCloud2.
    """
    points, fields = read_xyz(message)
    rgb = _read_colors(message, fields) if colors else None
    name = next((name for name in TIME_FIELDS if name in fields), None)
    if name is None or not len(points):
        return Cloud(points, None, colors=rgb)
    raw, is_hit = _read_column(message, fields[name]), np.isfinite(points).all(1) & (points != 0).any(1)
    times = to_seconds(raw, stamp, period, is_hit)
    note = describe_times(name, raw, times, stamp, period, is_hit)
    return Cloud(points, times, () if note is None else (note,), rgb)


def _read_colors(message: Any, fields: dict[str, Any]) -> NDArray[np.float32] | None:
    names = color_fields(fields)
    try:
        return to_colors([_read_column(message, fields[name]) for name in names]) if names else None
    except ValueError as error:
        raise CloudError(f"{', '.join(names)}: {error}") from error


def read_xyz(message: Any) -> tuple[NDArray[np.float32], dict[str, Any]]:
    """Return the points (N, 3) [m] of a sensor_msgs/PointCloud2, without their times, and its fields by name.

    Raises:
        CloudError: as `read_points`.
    """
    if not hasattr(message, "fields") or not hasattr(message, "point_step"):
        kind = type(message).__name__
        raise CloudError(
            f"message: expected a PointCloud2 with fields and point_step, got {kind}; deserialise it first"
        )
    fields = {field.name: field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise CloudError(f"the cloud has no field {', '.join(missing)}; it has {', '.join(fields) or 'none'}")
    columns = [_read_column(message, fields[name]) for name in "xyz"]
    with np.errstate(over="ignore"):  # a missing return may be the largest double
        return np.stack([column.astype(np.float32) for column in columns], -1), fields


def _read_column(message: Any, field: Any) -> NDArray:
    """Return the values of a field, (N,)."""
    if field.datatype not in _TYPES:
        raise CloudError(f"field {field.name} has the unknown type {field.datatype}")
    kind = np.dtype((">" if message.is_bigendian else "<") + _TYPES[field.datatype])
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    data = as_bytes(message.data)
    # Drivers leave row_step 0, or as it was before a crop: without padding, the number of bytes gives the rows.
    is_packed = height <= 1 or len(data) == height * width * step
    row = width * step if is_packed else int(message.row_step)
    if field.offset + kind.itemsize > step or row < width * step or len(data) < row * (height - 1) + width * step:
        sizes = f"{height} x {width} points of {step} bytes in rows of {row}, and {len(data)} bytes"
        rule = "the sizes of the cloud contradict each other"
        raise CloudError(f"{rule}: {sizes}", rule)
    if height * width == 0:
        return np.zeros(0, kind)
    shape, strides = (height, width), (row, step)
    view = np.ndarray(shape, kind, buffer=data, offset=int(field.offset), strides=strides)
    return view.ravel()
