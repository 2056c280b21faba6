"""Read depth images and camera intrinsics."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.errors import RecordingError

_HINT = "write four numbers fx fy cx cy [px], a 3x3 matrix, or YAML with those names"


class Intrinsics(NamedTuple):
    """A pinhole camera and the meaning of its depth values."""

    matrix: NDArray[np.float64]  #: (3, 3) [px]
    depth_scale: float = 0.001  #: [m] per unit of the image
    along: Literal["z", "ray"] = "z"  #: depth is measured along the optical axis, or along each pixel's ray


def read_depth(path: str | Path, depth_scale: float = 0.001) -> NDArray[np.float32]:
    """Read a 16-bit depth PNG.

    Args:
        path: the file.
        depth_scale: [m] per unit of the image: 0.001 for millimetres.

    Returns:
        Depth (H, W) [m], 0 where there was no return.

    Raises:
        RecordingError: the file is missing, cut short or not a single-channel 16-bit image.
    """
    import cv2

    path = Path(path)
    if not path.is_file():
        raise RecordingError(path, "no such file")
    # OpenCV silently fills the missing part of a truncated PNG with zeros; a complete one ends with an IEND chunk.
    if b"IEND" not in path.read_bytes()[-16:]:
        raise RecordingError(path, "cut short or not a PNG", "copy the file again")
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise RecordingError(path, "cannot be decoded", "copy the file again")
    if image.dtype != np.uint16 or image.ndim != 2:
        problem = f"expected one 16-bit channel, got {image.dtype} {image.shape}"
        raise RecordingError(path, problem, "save depth in millimetres as uint16")
    return image.astype(np.float32) * np.float32(depth_scale)


def read_intrinsics(path: str | Path) -> Intrinsics:
    """Read camera intrinsics from text or YAML.

    Text holds `fx fy cx cy`, optionally followed by `depth_scale`, or the nine numbers of a 3x3 matrix. YAML has the
    keys `fx fy cx cy`, or `K` or `camera_matrix` with nine numbers, as ROS writes them; `depth_scale` [m per unit] and
    `along` (`z` or `ray`) are optional.

    Args:
        path: the file.

    Returns:
        The camera.

    Raises:
        RecordingError: the file is missing, holds none of these, or its values are out of range.
    """
    path = Path(path)
    data = _load(path)
    numbers = _parse_numbers(data)
    if numbers is not None:
        return _from_numbers(path, numbers)
    if not isinstance(data, dict):
        raise RecordingError(path, "holds no intrinsics", _HINT)
    return _from_mapping(path, data)


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
        return yaml.safe_load("\n".join(lines).replace("!!opencv-matrix", ""))
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
        numbers = [numbers[0], numbers[4], numbers[2], numbers[5]]
    if len(numbers) != 4:
        raise RecordingError(path, f"holds {len(numbers)} numbers", _HINT)
    fx, fy, cx, cy = numbers
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    intrinsics = Intrinsics(matrix, **options)
    _check_values(path, intrinsics)
    return intrinsics


def _from_mapping(path: Path, data: dict) -> Intrinsics:
    options = {key: data[key] for key in ("depth_scale", "along") if key in data}
    matrix = next((data[key] for key in ("K", "k", "camera_matrix") if key in data), None)
    if isinstance(matrix, dict):
        matrix = matrix.get("data")
    numbers = _parse_numbers([data.get(key) for key in ("fx", "fy", "cx", "cy")] if matrix is None else matrix)
    if numbers is None or np.isnan(numbers).any():
        raise RecordingError(path, f"no fx, fy, cx, cy among the keys {list(data)}", _HINT)
    return _from_numbers(path, numbers, **options)


def _check_values(path: Path, intrinsics: Intrinsics) -> None:
    matrix, scale, along = intrinsics
    if not (np.isfinite(matrix).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise RecordingError(path, "fx and fy must be positive, all four finite", _HINT)
    if not (isinstance(scale, int | float) and 0 < scale <= 1):
        hint = "5000 units per metre are 0.0002, millimetres 0.001"
        raise RecordingError(path, f"depth_scale must be metres per unit, in (0, 1], got {scale}", hint)
    if along not in ("z", "ray"):
        raise RecordingError(path, f"along must be 'z' or 'ray', got {along!r}")
