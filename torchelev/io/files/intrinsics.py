"""Read camera intrinsics, as text, YAML or JSON in the forms that drivers and libraries write."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.errors import RecordingError

_HINT = "write four numbers fx fy cx cy [px], a 3x3 matrix, or YAML with those names"
_MATRIX = ("K", "k", "camera_matrix", "intrinsic_matrix", "intrinsics")
_PROJECTION = ("P", "p", "projection_matrix")
_NUMBERS = (("fx",), ("fy",), ("cx", "ppx"), ("cy", "ppy"))


class Intrinsics(NamedTuple):
    """A pinhole camera and the meaning of its depth values."""

    matrix: NDArray[np.float64]  #: (3, 3) [px]
    depth_scale: float = 0.001  #: [m] per unit of an image of integers
    along: Literal["z", "ray"] = "z"  #: depth is measured along the optical axis, or along each pixel's ray
    float_scale: float = 1.0  #: [m] per unit of an array of floats
    axes: str = "optical"  #: of the camera's frame, see `depth_to_points`


def read_intrinsics(path: str | Path) -> Intrinsics:
    """Read camera intrinsics from text, YAML or JSON.

    Text holds `fx fy cx cy`, optionally followed by `depth_scale`, or the nine numbers of a 3x3 matrix. YAML and JSON
    have the keys `fx fy cx cy` (or `ppx ppy`, as RealSense); or `K`, `camera_matrix` or Open3D's `intrinsic_matrix`
    with nine numbers; or are a CameraInfo as `ros2 topic echo` prints it, of which P is taken if it is filled in, as
    depth images are rectified. `depth_scale` [m per unit] and `along` (`z` or `ray`) are optional. Of several documents
    the first counts.

    Args:
        path: the file.

    Returns:
        The camera.

    Raises:
        RecordingError: the file is missing, holds none of these or several cameras, or its values are out of range.
    """
    path = Path(path)
    data = _load(path)
    numbers = _parse_numbers(data)
    if numbers is not None:
        return _from_numbers(path, numbers)
    if not isinstance(data, dict):
        raise RecordingError(path, "holds no intrinsics", _HINT)
    return _from_mapping(path, _find_camera(path, data))


def check_size(path: str | Path, intrinsics: Intrinsics, shape: tuple[int, ...]) -> None:
    """Raise RecordingError if the principal point is outside an image of `shape` (H, W): a mismatch of files."""
    (cx, cy), (height, width) = intrinsics.matrix[:2, 2], shape
    if not (0 < cx < width and 0 < cy < height):
        problem = f"the intrinsics' cx {cx:g}, cy {cy:g} lie outside this image of {width} x {height} px"
        raise RecordingError(path, problem, "give the intrinsics of this camera at this size")


def _load(path: Path) -> Any:
    import yaml

    if not path.is_file():
        raise RecordingError(path, "no such intrinsics file", "give one with --intrinsics")
    try:
        text = path.read_text(encoding="utf-8-sig")
        lines = [line for line in text.splitlines() if not line.startswith("%YAML")]  # OpenCV's header is not YAML
        return next(yaml.safe_load_all("\n".join(lines).replace("!!opencv-matrix", "")), None)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise RecordingError(path, f"is neither text nor YAML ({error})", _HINT) from error


def _parse_numbers(data: object) -> list[float] | None:
    """Return the numbers of plain text, which YAML loads as a string or, with brackets, as a list; else None."""
    words = data.replace(",", " ").split() if isinstance(data, str) else data if isinstance(data, list) else None
    try:
        return None if words is None else np.array(words, dtype=np.float64).ravel().tolist()
    except (TypeError, ValueError):
        return None


def _from_numbers(path: Path, numbers: list[float], **options: Any) -> Intrinsics:
    if len(numbers) == 5:
        options["depth_scale"] = numbers.pop()
    if len(numbers) == 9:
        column_wise = numbers[2] == numbers[5] == 0 and numbers[6] > 0 and numbers[7] > 0  # as Open3D writes
        cx, cy = (numbers[6], numbers[7]) if column_wise else (numbers[2], numbers[5])
        numbers = [numbers[0], numbers[4], cx, cy]
    if len(numbers) != 4:
        raise RecordingError(path, f"holds {len(numbers)} numbers", _HINT)
    fx, fy, cx, cy = numbers
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    intrinsics = Intrinsics(matrix, **options)
    _check_values(path, intrinsics)
    return intrinsics


def _find_camera(path: Path, data: dict) -> dict:
    """Return the mapping that holds a camera: the file's, or the only one in it."""
    if _camera_numbers(data) is not None:
        return data
    inner = {str(key): value for key, value in data.items() if isinstance(value, dict)}
    cameras = {key: value for key, value in inner.items() if _camera_numbers(value) is not None}
    if len(cameras) > 1:
        raise RecordingError(path, f"holds several cameras: {', '.join(cameras)}", "keep the one of the depth images")
    return next(iter(cameras.values()), data)


def _from_mapping(path: Path, data: dict) -> Intrinsics:
    options = {key: data[key] for key in ("depth_scale", "along") if key in data}
    numbers = _camera_numbers(data)
    if numbers is None:
        raise RecordingError(path, f"no fx, fy, cx, cy among the keys {list(data)}", _HINT)
    if not any(numbers):
        raise RecordingError(path, "the CameraInfo is not calibrated: k and p hold zeros", _HINT)
    return _from_numbers(path, numbers, **options)


def _camera_numbers(data: dict) -> list[float] | None:
    """Return the four or nine numbers of a camera; None if there are none."""
    projection = _matrix_numbers(data, _PROJECTION)
    if projection is not None and len(projection) == 12 and projection[0] > 0:
        return [projection[k] for k in (0, 5, 2, 6)]
    matrix = _matrix_numbers(data, _MATRIX)
    if matrix is not None:
        return matrix
    numbers = _parse_numbers([next((data[key] for key in keys if key in data), None) for keys in _NUMBERS])
    return None if numbers is None or np.isnan(numbers).any() else numbers


def _matrix_numbers(data: dict, keys: tuple[str, ...]) -> list[float] | None:
    value = next((data[key] for key in keys if key in data), None)
    return _parse_numbers(value.get("data") if isinstance(value, dict) else value)


def _check_values(path: Path, intrinsics: Intrinsics) -> None:
    matrix, scale, along = intrinsics.matrix, intrinsics.depth_scale, intrinsics.along
    if not (np.isfinite(matrix).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise RecordingError(path, "fx and fy must be positive, all four finite", _HINT)
    if not (isinstance(scale, int | float) and 0 < scale <= 1):
        hint = "5000 units per metre are 0.0002, millimetres 0.001"
        raise RecordingError(path, f"depth_scale must be metres per unit, in (0, 1], got {scale}", hint)
    if along not in ("z", "ray"):
        raise RecordingError(path, f"along must be 'z' or 'ray', got {along!r}")
