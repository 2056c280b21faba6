"""Points and their times out of a PointCloud2 message, whatever the layout of its fields."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# sensor_msgs/PointField
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_TIME_FIELDS = ("t", "time", "timestamp", "time_stamp", "offset_time", "time_offset", "ts")
_UNITS = (1.0, 1e-3, 1e-6, 1e-9)  # [s]
_SCAN = (2e-3, 2.0)  # [s] how long a scan may take
_ABSOLUTE = 1e8  # [s] since 1970; larger times are no offsets from the message's stamp


class CloudError(ValueError):
    """A message contradicts itself, or holds no points."""


class Cloud(NamedTuple):
    """Points of a message."""

    points: NDArray[np.float32]  #: (N, 3) [m]; NaN where there is no return
    times: NDArray[np.float64] | None  #: (N,) [s] from the message's stamp; None: all at once
    note: str  #: why a field of times is not used, or ""


def read_points(message: Any, stamp: float) -> Cloud:
    """Return the points of a sensor_msgs/PointCloud2.

    Fields may have any order, padding, byte order and type; rows may be padded, too. Times are a field named t, time,
    timestamp, time_stamp, offset_time, time_offset or ts. Their unit is the one of s, ms, us and ns in which the scan
    takes 2 ms to 2 s, seconds first for floats and nanoseconds first for integers. They count from the message's stamp,
    or from 1970.

    Args:
        message: the message.
        stamp: [s] of its header.

    Raises:
        CloudError: there is no x, y or z, or the sizes contradict each other.
    """
    fields = {field.name: field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise CloudError(f"the cloud has no field {', '.join(missing)}; it has {', '.join(fields) or 'none'}")
    columns = [_read_column(message, fields[name]) for name in "xyz"]
    points = np.stack([column.astype(np.float32) for column in columns], -1)
    name = next((name for name in _TIME_FIELDS if name in fields), None)
    if name is None or not len(points):
        return Cloud(points, None, "")
    raw = _read_column(message, fields[name])
    times = to_seconds(raw, stamp)
    if times is None and np.ptp(raw) == 0:  # of a camera, or of a driver that does not fill it
        return Cloud(points, None, "")
    note = (
        "" if times is not None else f"the times in field {name} do not look like those of one scan, and are not used"
    )
    return Cloud(points, times, note)


def _read_column(message: Any, field: Any) -> NDArray:
    """Return the values of a field, (N,)."""
    if field.datatype not in _TYPES:
        raise CloudError(f"field {field.name} has the unknown type {field.datatype}")
    kind = np.dtype((">" if message.is_bigendian else "<") + _TYPES[field.datatype])
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    row = int(message.row_step) if height > 1 else width * step
    data = np.asarray(message.data, dtype=np.uint8)
    if field.offset + kind.itemsize > step or row < width * step or len(data) < row * (height - 1) + width * step:
        sizes = f"{height} x {width} points of {step} bytes in rows of {row}, and {len(data)} bytes"
        raise CloudError(f"the sizes of the cloud contradict each other: {sizes}")
    if height * width == 0:
        return np.zeros(0, kind)
    shape, strides = (height, width), (row, step)
    view = np.ndarray(shape, kind, buffer=np.ascontiguousarray(data), offset=int(field.offset), strides=strides)
    return view.ravel()


def to_seconds(raw: NDArray, stamp: float) -> NDArray[np.float64] | None:
    """Return times (N,) [s] from the stamp [s]; None if they are not those of a scan in any unit."""
    is_integer = raw.dtype.kind in "iu"
    times = raw.astype(np.longdouble)
    finite = times[np.isfinite(times)]
    if not finite.size:
        return None
    for unit in reversed(_UNITS) if is_integer else _UNITS:
        span = float(finite.max() - finite.min()) * unit
        if not _SCAN[0] <= span <= _SCAN[1]:
            continue
        is_absolute = float(abs(finite.min())) * unit > _ABSOLUTE
        seconds = times * unit - (np.longdouble(stamp) if is_absolute else 0)
        if float(np.abs(finite.min() * unit - (stamp if is_absolute else 0))) <= _SCAN[1]:
            return seconds.astype(np.float64)
    return None
