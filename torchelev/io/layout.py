"""What files do not say of themselves: how their numbers are laid out, and what gives a wrong guess away."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.errors import RecordingError

HEAD_BYTES = 480 * 40  # that layouts are told from; a whole number of points of every layout below
MIN_POINTS = 32  # fewer tell nothing
TILT_STEADY, TILT_TURNING = 10.0, 25.0  # [deg] a sensor on a robot keeps its tilt within the first
MIN_STEP, MAX_STEP = 1e-4, 10.0  # [s] between scans of any sensor that drives
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
BIN_HINT = "say which with --bin-layout (float32x5: nuScenes)"


@dataclass(frozen=True, kw_only=True)
class FileLayout:
    """The layout of a recording's files; None: as told from the files, or refused where they contradict it."""

    bin: str | None = None  #: of `.bin`: float32 or float64, x, and numbers per point; None: float32x4, as KITTI
    quaternions: Literal["xyzw", "wxyz"] | None = None  #: of pose files with 8 columns; None: xyzw, as TUM
    time_unit: Literal["s", "ms", "us", "ns"] | None = None  #: of their times; None: s, or of times since 1970 any
    pcd_frame: Literal["sensor", "viewpoint"] | None = None  #: of `.pcd`: sensor, or that in which VIEWPOINT is

    def __post_init__(self) -> None:
        if self.bin is not None:
            parse_bin(self.bin)


class BinLayout(NamedTuple):
    """Numbers of a `.bin`, x y z first."""

    dtype: str  #: NumPy's name of a value's type, such as "<f4"
    columns: int  #: values of each point

    @property
    def num_bytes(self) -> int:
        return np.dtype(self.dtype).itemsize * self.columns

    def __str__(self) -> str:
        return f"float{8 * np.dtype(self.dtype).itemsize}x{self.columns}"


KITTI = BinLayout("<f4", 4)
OTHERS = [BinLayout("<f4", columns) for columns in (3, 5, 6)] + [BinLayout("<f8", columns) for columns in (3, 4, 5, 6)]


def parse_bin(text: str) -> BinLayout:
    """Return the layout that `text` names, such as float32x5. Raises ValueError for anything else."""
    match = re.fullmatch(r"float(32|64)x(\d{1,2})", text)
    if match is None or int(match[2]) < 3:
        raise ValueError(f"--bin-layout: must be float32 or float64, x, and 3 or more numbers per point, got {text!r}")
    return BinLayout(f"<f{int(match[1]) // 8}", int(match[2]))


def read_bin(path: Path, layout: str | None = None) -> NDArray:
    """Read x y z (N, 3) of a `.bin`; without a `layout` it must be KITTI's by its size and its values."""
    chosen, size = KITTI if layout is None else parse_bin(layout), path.stat().st_size
    if size % chosen.num_bytes:
        problem = f"cut short: {size} bytes are no whole number of points of {chosen}"
        fitting = ", ".join(str(other) for other in OTHERS if size % other.num_bytes == 0)
        hint = f"; {fitting} would fit: {BIN_HINT}" if fitting and layout is None else ""
        raise RecordingError(path, problem, f"expected x y z first; copy the file again{hint}")
    if layout is None:
        with np.errstate(invalid="ignore"):  # random bits are signalling NaN too
            _require_kitti(path, size)
    return np.fromfile(path, dtype=chosen.dtype).reshape(-1, chosen.columns)[:, :3]


def _require_kitti(path: Path, size: int) -> None:
    """Refuse a file whose values are of another layout."""
    raw = np.fromfile(path, dtype=np.uint8, count=min(size, HEAD_BYTES))
    kitti = _values(raw, KITTI)
    if len(kitti) < MIN_POINTS:
        return
    for other in OTHERS:
        values = _values(raw, other)
        fits = size % other.num_bytes == 0 and _plausible(values[:, :3]) > 0.97
        if fits and other.dtype == "<f8":
            empty = not kitti[:, [0, 2]].any()  # the low halves of round numbers
            better = _plausible(kitti) < 0.9 or empty
        else:
            better = _structure(values) > 0.1 + _structure(kitti)
        if fits and better:
            likely = max((o for o in OTHERS if o.dtype == other.dtype and size % o.num_bytes == 0),
                         key=lambda o: _structure(_values(raw, o)) - 0.01 * o.columns)  # fmt: skip
            problem = f"does not look like KITTI's float32 x y z intensity but like {likely}"
            raise RecordingError(path, problem, BIN_HINT.replace("which", "so") + ", or float32x4 if it is KITTI's")
    if _plausible(kitti[:, :3]) < 0.9:
        raise RecordingError(path, "holds numbers that are no coordinates in metres", BIN_HINT)


def _values(raw: NDArray, layout: BinLayout) -> NDArray:
    """Return the first points (N, C) of a layout."""
    count = len(raw) // layout.num_bytes
    return raw[: count * layout.num_bytes].view(layout.dtype).reshape(count, layout.columns)


def _plausible(values: NDArray) -> float:
    """Return the share of the values that coordinates may have [m]: random bits have any exponent."""
    size = np.abs(values)
    return float(np.mean((size == 0) | ~np.isfinite(values) | ((size > 1e-12) & (size < 1e5))))


def _structure(values: NDArray) -> float:
    """Return how much columns differ (0 to 1): read at a wrong period, each is a mixture of all the numbers.

    The share of the ranks' variance, of values and of sizes, that lies between columns.
    """
    values = np.nan_to_num(values.astype(np.float64), posinf=0, neginf=0)
    return max(_between(values), _between(np.abs(values)))


def _between(values: NDArray) -> float:
    _, index, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(counts) - counts / 2)[index].reshape(values.shape)
    total = ranks.var()
    return float(ranks.mean(axis=0).var() / total) if total > 0 else 0.0


def quaternion_order(path: Path, comments: str, quaternions: NDArray, order: str | None) -> str:
    """Return xyzw or wxyz for the columns (T, 4) of a pose file: as told, as its comments say, else xyzw.

    Raises RecordingError if read as xyzw the sensor turns over or hangs upside down, and read as wxyz it does not: an
    order that is wrong passes every other check.
    """
    if order is not None:
        return order
    names = re.findall(r"\bq_?[wx]\b", comments.lower())
    if len(names) == 2:
        return "wxyz" if names[0].endswith("w") else "xyzw"
    ups = {name: _up_in_sensor(quaternions[:, columns]) for name, columns in ORDERS.items()}
    tilt = {name: _largest_angle(up) for name, up in ups.items()}
    mean = {name: float(up[:, 2].mean()) for name, up in ups.items()}
    steady = tilt["wxyz"] < TILT_STEADY
    turning = tilt["xyzw"] > TILT_TURNING
    hanging = mean["xyzw"] < -0.8 and mean["wxyz"] > 0.8
    if steady and (turning or hanging):
        does = "turns over as it moves" if turning else "hangs upside down"
        problem = f"read as qx qy qz qw the sensor {does}, read as qw qx qy qz it keeps its tilt"
        raise RecordingError(path, problem, "say which with --quaternions wxyz (or xyzw)")
    return "xyzw"


ORDERS = {"xyzw": [0, 1, 2, 3], "wxyz": [1, 2, 3, 0]}  # columns of x y z w


def _up_in_sensor(quat_xyzw: NDArray) -> NDArray:
    """Return the map's z axis in the sensor's frame (T, 3): the last row of each rotation."""
    x, y, z, w = quat_xyzw.T
    return np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=-1)


def _largest_angle(directions: NDArray) -> float:
    """Return the largest angle [deg] between the directions (T, 3) and their mean."""
    mean = directions.mean(axis=0)
    cosine = directions @ mean / max(float(np.linalg.norm(mean)), 1e-9)
    return float(np.degrees(np.arccos(np.clip(cosine.min(), -1, 1))))


def seconds(path: Path, times: NDArray, unit: str | None) -> NDArray:
    """Return times (T,) in seconds. Without a `unit` times since 1970 tell theirs by their size, others are seconds."""
    if unit is not None:
        return times * UNITS[unit]
    # Seconds since 1970 are about 2e9, the other units' thousands of times more.
    digits = np.log10(max(float(np.abs(times).max()), 1.0))
    return times / 1000.0 ** max(0.0, np.floor((digits - 8) / 3))


def require_plausible_steps(path: Path, steps: NDArray) -> None:
    """Refuse times between scans (T,) [s], the first of which does not count, that no sensor on a robot has."""
    forward = steps[1:][steps[1:] > 0]
    if len(steps) > 1 and not len(forward):
        raise RecordingError(path, "all poses have the same time", "give the time between scans with --dt")
    middle = float(np.median(forward)) if len(forward) else 1.0
    if not MIN_STEP <= middle <= MAX_STEP:
        problem = f"{middle:.3g} s between scans (median): are the times in another unit?"
        raise RecordingError(path, problem, "say so with --time-unit ms, us or ns (or s if it is right), or give --dt")
