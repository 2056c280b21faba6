"""Conventions that files do not state: column layout, quaternion order, time unit; with defaults and checks."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.errors import RecordingError

XYZW_COLUMNS = {"xyzw": [0, 1, 2, 3], "wxyz": [1, 2, 3, 0]}  # by order: columns that hold x, y, z, w
_HEAD_BYTES = 480 * 40  # of a `.bin`, inspected to detect its layout; a whole number of points of every layout below
_MIN_POINTS = 32  # with fewer, nothing is detected
_STEADY_TILT, _TURNING_TILT = 10.0, 25.0  # [deg] the tilt of a sensor on a robot varies by less than the first
_MIN_STEP, _MAX_STEP = 1e-4, 10.0  # [s] plausible times between scans
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_BIN_HINT = "with --bin-layout (float32x5: nuScenes)"


@dataclass(frozen=True, kw_only=True)
class FileLayout:
    """Conventions that a recording's files do not state. None: the default, refused if a file contradicts it."""

    #: of `.bin` files: float32 or float64, "x", numbers per point. None: float32x4, as KITTI
    bin: str | None = None
    #: order of quaternions in pose files with 8 columns. None: as their comments say, or xyzw, as TUM
    quaternions: Literal["xyzw", "wxyz"] | None = None
    #: of timestamps in pose files. None: s, or for times since 1970 detected from their size
    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    #: of `.pcd` points: the sensor's, or the frame in which VIEWPOINT is given. None: VIEWPOINT must be the identity
    pcd_frame: Literal["sensor", "viewpoint"] | None = None

    def __post_init__(self) -> None:
        if self.bin is not None:
            _parse_bin(self.bin)


class _BinLayout(NamedTuple):
    """Numbers of each point of a `.bin`, x y z first."""

    dtype: str
    columns: int

    @property
    def num_bytes(self) -> int:
        return np.dtype(self.dtype).itemsize * self.columns

    def __str__(self) -> str:
        return f"float{8 * np.dtype(self.dtype).itemsize}x{self.columns}"


_KITTI = _BinLayout("<f4", 4)
_OTHER_LAYOUTS = [_BinLayout("<f4", n) for n in (3, 5, 6)] + [_BinLayout("<f8", n) for n in (3, 4, 5, 6)]


def read_bin(path: Path, layout: str | None = None) -> NDArray:
    """Read the numbers (N, C) of a `.bin`, x y z first; without a `layout` its size and values must fit KITTI's."""
    chosen, size = _KITTI if layout is None else _parse_bin(layout), path.stat().st_size
    if size % chosen.num_bytes:
        problem = f"cut short: {size} bytes are not a whole number of points of {chosen}"
        fitting = ", ".join(str(other) for other in _OTHER_LAYOUTS if size % other.num_bytes == 0)
        hint = f"; {fitting} would fit: say which {_BIN_HINT}" if fitting and layout is None else ""
        raise RecordingError(path, problem, f"expected x y z first; copy the file again{hint}")
    if layout is None:
        with np.errstate(invalid="ignore"):  # other layouts read as float32 can give signalling NaN
            _require_kitti(path, size)
    return np.fromfile(path, dtype=chosen.dtype).reshape(-1, chosen.columns)


def _parse_bin(text: str) -> _BinLayout:
    match = re.fullmatch(r"float(32|64)x(\d{1,2})", text)
    if match is None or int(match[2]) < 3:
        raise ValueError(f"--bin-layout: must be float32 or float64, x, and 3 or more numbers per point, got {text!r}")
    return _BinLayout(f"<f{int(match[1]) // 8}", int(match[2]))


def _require_kitti(path: Path, size: int) -> None:
    """Refuse a `.bin` whose first values fit another layout clearly better."""
    head = np.fromfile(path, dtype=np.uint8, count=min(size, _HEAD_BYTES))
    if len(_values(head, _KITTI)) < _MIN_POINTS:
        return
    fitting = [other for other in _OTHER_LAYOUTS if size % other.num_bytes == 0]
    for other in fitting:
        if _fits_better(head, other):
            same_dtype = [layout for layout in fitting if layout.dtype == other.dtype]
            likely = max(same_dtype, key=lambda layout: _contrast(_values(head, layout)) - 0.01 * layout.columns)
            problem = f"does not look like KITTI's float32 x y z intensity but like {likely}"
            raise RecordingError(path, problem, f"say so {_BIN_HINT}, or float32x4 if it is KITTI's")
    if _plausible_fraction(_values(head, _KITTI)[:, :3]) < 0.9:
        raise RecordingError(path, "holds numbers that are not coordinates in metres", f"say which {_BIN_HINT}")


def _fits_better(head: NDArray, other: _BinLayout) -> bool:
    """Return whether another layout explains the values clearly better than KITTI's."""
    values, kitti = _values(head, other), _values(head, _KITTI)
    if _plausible_fraction(values[:, :3]) <= 0.97:
        return False
    if other.dtype == "<f8":
        has_empty_halves = not kitti[:, [0, 2]].any()  # round float64 numbers have zeros in their lower 4 bytes
        return _plausible_fraction(kitti) < 0.9 or has_empty_halves
    return _contrast(values) > 0.1 + _contrast(kitti)


def _values(head: NDArray, layout: _BinLayout) -> NDArray:
    """Return the whole points (N, C) in the file's first bytes."""
    num_points = len(head) // layout.num_bytes
    return head[: num_points * layout.num_bytes].view(layout.dtype).reshape(num_points, layout.columns)


def _plausible_fraction(values: NDArray) -> float:
    """Return the fraction of values that can be coordinates [m]; misread bits give numbers of any exponent."""
    size = np.abs(values)
    return float(np.mean((size == 0) | ~np.isfinite(values) | ((size > 1e-12) & (size < 1e5))))


def _contrast(values: NDArray) -> float:
    """Return how much columns differ, 0 to 1; with a wrong number of columns, each one mixes all quantities.

    This is the fraction of the variance of ranks (of values, or of absolute values) that lies between columns.
    """
    values = np.nan_to_num(values.astype(np.float64), posinf=0, neginf=0)
    return max(_variance_between(values), _variance_between(np.abs(values)))


def _variance_between(values: NDArray) -> float:
    _, index, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(counts) - counts / 2)[index].reshape(values.shape)
    total = ranks.var()
    return float(ranks.mean(axis=0).var() / total) if total > 0 else 0.0


def detect_quaternion_order(path: Path, comments: str, quaternions: NDArray, order: str | None) -> str:
    """Return the order of quaternions (T, 4) in a pose file, "xyzw" or "wxyz".

    `order` takes precedence, then the column names in the file's comments, then the default, xyzw. Since a wrong order
    passes every other check, raise RecordingError if the sensor would turn over or hang upside down read as xyzw, but
    not read as wxyz.
    """
    if order is not None:
        return order
    names = re.findall(r"\bq_?[wx]\b", comments.lower())
    if len(names) == 2:
        return "wxyz" if names[0].endswith("w") else "xyzw"
    ups = {name: _up_in_sensor(quaternions[:, columns]) for name, columns in XYZW_COLUMNS.items()}
    tilt = {name: _largest_angle(up) for name, up in ups.items()}
    mean_up = {name: float(up[:, 2].mean()) for name, up in ups.items()}
    turns_over = tilt["xyzw"] > _TURNING_TILT
    hangs = mean_up["xyzw"] < -0.8 and mean_up["wxyz"] > 0.8
    if tilt["wxyz"] < _STEADY_TILT and (turns_over or hangs):
        motion = "turns over as it moves" if turns_over else "hangs upside down"
        problem = f"read as qx qy qz qw the sensor {motion}, read as qw qx qy qz it keeps its tilt"
        raise RecordingError(path, problem, "say which with --quaternions wxyz (or xyzw)")
    return "xyzw"


def _up_in_sensor(quat_xyzw: NDArray) -> NDArray:
    """Return the map's z axis in the sensor frame (T, 3): the last row of each rotation matrix."""
    x, y, z, w = quat_xyzw.T
    return np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=-1)


def _largest_angle(directions: NDArray) -> float:
    """Return the largest angle [deg] between directions (T, 3) and their mean."""
    mean = directions.mean(axis=0)
    cosine = directions @ mean / max(float(np.linalg.norm(mean)), 1e-9)
    return float(np.degrees(np.arccos(np.clip(cosine.min(), -1, 1))))


def stamps_to_seconds(times: NDArray, unit: str | None) -> NDArray:
    """Return times (T,) in seconds; without a `unit`, they are in s, or since 1970 in the unit that fits their size."""
    if unit is not None:
        return times * _SECONDS[unit]
    # Seconds since 1970 are about 2e9; in ms, us or ns the number is larger by powers of 1000.
    digits = np.log10(max(float(np.abs(times).max()), 1.0))
    return times / 1000.0 ** max(0.0, np.floor((digits - 8) / 3))


def require_plausible_steps(path: Path, steps: NDArray) -> None:
    """Refuse times since the previous scan (T,) [s] that no real sensor has; the first is ignored."""
    forward = steps[1:][steps[1:] > 0]
    if len(steps) > 1 and not len(forward):
        raise RecordingError(path, "all poses have the same time", "give the time between scans with --dt")
    median = float(np.median(forward)) if len(forward) else 1.0
    if not _MIN_STEP <= median <= _MAX_STEP:
        problem = f"{median:.3g} s between scans (median): are the timestamps in another unit?"
        raise RecordingError(path, problem, "say so with --time-unit ms, us or ns (or s if it is right), or give --dt")
