"""Clouds from arrays: find which shapes and columns are points, and further columns such as times."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.errors import RecordingError
from torchelev.io.points.colors import color_fields, to_colors
from torchelev.io.points.times import TIME_FIELDS

MAX_COLUMNS = 16  # numbers per point; wider arrays are images, or have one column per point
_TIME_ARRAYS = (*TIME_FIELDS, "times", "timestamps")  # beside the points of a .npz
_TIME_KINDS = "fiumM"
_DEPTH_HINT = "of a depth image give the camera with --intrinsics"


class CloudFile(NamedTuple):
    """The contents of a file with a cloud."""

    points: NDArray  #: (N, 3) [m]
    times: NDArray | None = None  #: (N,) as the file gives them; None: none
    time_name: str = ""  #: of their field
    others: NDArray | None = None  #: (N, C) columns without a name, one of which may be a time
    colors: NDArray[np.float32] | None = None  #: (N, 3) from 0 to 1; None: none


def load_npy(path: Path) -> NDArray:
    """Return the array of a `.npy`; RecordingError if it is cut short or none."""
    try:
        return np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:  # NumPy's own message blames pickle, which would mislead
        raise RecordingError(path, "cut short or not a .npy file", "save it again with numpy.save") from error


def load_npz(path: Path, names: tuple[str, ...]) -> tuple[NDArray, dict[str, NDArray]]:
    """Return the array of a `.npz` that has one of the names, or its only one, and the arrays of times beside it."""
    try:
        with zipfile.ZipFile(path) as archive:
            keys = [name.removesuffix(".npy") for name in archive.namelist()]
        key = _choose_key(path, keys, names)
        with np.load(path, allow_pickle=False) as arrays:
            return arrays[key], {name: arrays[name] for name in _TIME_ARRAYS if name in keys and name != key}
    except RecordingError:
        raise
    except (zipfile.BadZipFile, ValueError, OSError, EOFError) as error:
        raise RecordingError(path, "cut short or not a .npz file", "save it again with numpy.savez") from error


def read_npy(path: Path) -> CloudFile:
    """Read a `.npy`."""
    return from_array(path, load_npy(path))


def read_npz(path: Path) -> CloudFile:
    """Read a `.npz`: points, and times in an array of as many numbers beside them."""
    array, beside = load_npz(path, ("points", "xyz"))
    cloud = from_array(path, array)
    for name, values in beside.items():
        if cloud.times is None and values.size == len(cloud.points) and values.dtype.kind in _TIME_KINDS:
            return cloud._replace(times=_to_numbers(values), time_name=name)
    return cloud


def from_array(path: Path, array: NDArray) -> CloudFile:
    """Return the cloud of an array (..., C >= 3) or of a structured array with fields x, y, z."""
    if array.dtype.names:
        return from_fields(path, array)
    _require_points(path, array)
    rows = array.reshape(-1, array.shape[-1])
    return CloudFile(rows[:, :3], others=rows[:, 3:] if rows.shape[1] > 3 else None)


def from_fields(path: Path, array: Any) -> CloudFile:
    """Return the cloud of a structured array."""
    names = array.dtype.names or ()
    missing = {"x", "y", "z"} - set(names)
    if missing:
        raise RecordingError(path, f"no field {' '.join(sorted(missing))}", "the cloud needs fields x, y and z")
    points = np.stack([np.asarray(array[name]).ravel() for name in "xyz"], axis=-1)
    name = next((name for name in TIME_FIELDS if name in names and array.dtype[name].kind in _TIME_KINDS), None)
    times = None if name is None else _to_numbers(np.asarray(array[name]))
    times = times if times is not None and len(times) == len(points) else None
    return CloudFile(points, times, name or "", colors=_colors(array))


def _colors(array: Any) -> NDArray[np.float32] | None:
    fields = color_fields(array.dtype.names)
    try:
        return to_colors([np.asarray(array[name]).ravel() for name in fields]) if fields else None
    except ValueError:  # they may not be asked for
        return None


def _to_numbers(times: NDArray) -> NDArray:
    """Return times as numbers (N,): datetime64 and timedelta64 as integers [ns]."""
    kind = times.dtype.kind
    return (times.astype(f"{kind}8[ns]").astype(np.int64) if kind in "mM" else times).ravel()


def is_cloud(array: NDArray) -> bool:
    """Return whether an array has the shape of a cloud: one row x y z ... per point."""
    columns = array.shape[-1] if array.ndim >= 2 else 0
    is_tall = array.ndim > 2 or columns <= array.shape[0] or array.shape[0] in (0, 1)
    return bool(array.dtype.names) or (array.dtype.kind in "fiu" and 3 <= columns <= MAX_COLUMNS and is_tall)


def _require_points(path: Path, array: NDArray) -> None:
    """Refuse arrays that are not clouds: images, columns first, other types."""
    given = f"{array.dtype} {array.shape}"
    if array.ndim < 2 or array.dtype.kind not in "fiu":
        raise RecordingError(path, f"expected numbers (N, 3), got {given}", "save one row x y z per point")
    if array.dtype == np.uint8:
        raise RecordingError(path, f"expected points in metres, got {given}, as of a picture", "save float32 points")
    if is_cloud(array):
        return
    hint = "save one row x y z per point"
    if 3 <= array.shape[0] <= MAX_COLUMNS and array.shape[-1] > array.shape[0]:
        hint = f"save it transposed, {hint.removeprefix('save ')}"
    elif array.ndim <= 4 and min(array.shape[:2]) >= 1:
        hint = f"{_DEPTH_HINT}; of a cloud {hint}"
    raise RecordingError(path, f"expected points (N, 3), with {MAX_COLUMNS} columns at most, got {given}", hint)


def _choose_key(path: Path, keys: list[str], names: tuple[str, ...]) -> str:
    for key in names:
        if key in keys:
            return key
    others = [key for key in keys if key not in _TIME_ARRAYS]
    if len(others) != 1:
        raise RecordingError(path, f"no array '{names[0]}' among {keys}", f"name the array '{names[0]}'")
    return others[0]
