"""Read depth images and camera intrinsics."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.errors import RecordingError

EXPECTED = "write four numbers fx fy cx cy [px], a 3x3 matrix, or YAML with those names"


class Intrinsics(NamedTuple):
    """A pinhole camera and what its depth values mean."""

    matrix: NDArray[np.float64]  #: (3, 3) [px]
    depth_scale: float = 0.001  #: metres per unit of the image
    along: Literal["z", "ray"] = "z"  #: depth along the optical axis, or along each pixel's ray


def read_depth(path: str | Path, depth_scale: float = 0.001) -> NDArray[np.float32]:
    """Read a uint16 depth PNG -> (H, W) float32 [m], 0 where the camera saw nothing.

    `depth_scale` is metres per unit (0.001 for millimetres). Raises RecordingError for a file that is missing, cut
    short or not a single-channel 16-bit image.
    """
    import cv2

    path = Path(path)
    if not path.is_file():
        raise RecordingError(path, "no such file")
    # OpenCV fills what a cut PNG lacks with zeros and says nothing; a whole one ends with its IEND chunk.
    if b"IEND" not in path.read_bytes()[-16:]:
        raise RecordingError(path, "cut short or no PNG", "copy the file again")
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise RecordingError(path, "cannot be decoded", "copy the file again")
    if image.dtype != np.uint16 or image.ndim != 2:
        problem = f"expected one 16-bit channel, got {image.dtype} {image.shape}"
        raise RecordingError(path, problem, "save depth in millimetres as uint16")
    return image.astype(np.float32) * np.float32(depth_scale)


def read_intrinsics(path: str | Path) -> Intrinsics:
    """Read intrinsics: `fx fy cx cy [depth_scale]`, nine numbers of a 3x3 matrix, or YAML.

    YAML keys: `fx fy cx cy`, or `K` / `camera_matrix` (nine numbers, as ROS writes them), with optional `depth_scale`
    [m per unit] and `along` (`z` or `ray`). Raises RecordingError if none of these is there.
    """
    path = Path(path)
    data = _load(path)
    numbers = _flat_numbers(data)
    if numbers is not None:
        return _from_numbers(path, numbers)
    if not isinstance(data, dict):
        raise RecordingError(path, "holds no intrinsics", EXPECTED)
    return _from_mapping(path, data)


def check_size(path: str | Path, intrinsics: Intrinsics, shape: tuple[int, ...]) -> None:
    """Raise RecordingError if the principal point lies outside an image of `shape` (H, W): a wrong pair of files."""
    (cx, cy), (height, width) = intrinsics.matrix[:2, 2], shape
    if not (0 < cx < width and 0 < cy < height):
        problem = f"the intrinsics' cx {cx:g}, cy {cy:g} lie outside this image of {width} x {height} px"
        raise RecordingError(path, problem, "give the intrinsics of this camera at this size")


def _load(path: Path):
    import yaml

    if not path.is_file():
        raise RecordingError(path, "no such intrinsics file", "give one with --intrinsics")
    try:
        text = path.read_text(encoding="utf-8-sig")
        lines = [line for line in text.splitlines() if not line.startswith("%YAML")]  # OpenCV's own heading
        return yaml.safe_load("\n".join(lines).replace("!!opencv-matrix", ""))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise RecordingError(path, f"is neither text nor YAML ({error})", EXPECTED) from error


def _flat_numbers(data) -> list[float] | None:
    """The numbers of plain text, which YAML reads as one string (or as a list, with brackets)."""
    words = data.replace(",", " ").split() if isinstance(data, str) else data if isinstance(data, list) else None
    try:
        return None if words is None else np.array(words, dtype=np.float64).ravel().tolist()
    except (TypeError, ValueError):
        return None


def _from_numbers(path: Path, numbers: list[float], **more) -> Intrinsics:
    if len(numbers) == 5:
        more["depth_scale"] = numbers.pop()
    if len(numbers) == 9:
        numbers = [numbers[0], numbers[4], numbers[2], numbers[5]]
    if len(numbers) != 4:
        raise RecordingError(path, f"holds {len(numbers)} numbers", EXPECTED)
    fx, fy, cx, cy = numbers
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return _checked(path, Intrinsics(matrix, **more))


def _from_mapping(path: Path, data: dict) -> Intrinsics:
    more = {key: data[key] for key in ("depth_scale", "along") if key in data}
    matrix = next((data[key] for key in ("K", "k", "camera_matrix") if key in data), None)
    if isinstance(matrix, dict):
        matrix = matrix.get("data")
    numbers = _flat_numbers([data.get(key) for key in ("fx", "fy", "cx", "cy")] if matrix is None else matrix)
    if numbers is None or np.isnan(numbers).any():
        raise RecordingError(path, f"no fx, fy, cx, cy among the keys {list(data)}", EXPECTED)
    return _from_numbers(path, numbers, **more)


def _checked(path: Path, intrinsics: Intrinsics) -> Intrinsics:
    matrix, scale, along = intrinsics
    if not (np.isfinite(matrix).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise RecordingError(path, "fx and fy must be positive, all four finite", EXPECTED)
    if not (isinstance(scale, int | float) and 0 < scale <= 1):
        hint = "5000 units per metre are 0.0002, millimetres 0.001"
        raise RecordingError(path, f"depth_scale is metres per unit, in (0, 1], got {scale}", hint)
    if along not in ("z", "ray"):
        raise RecordingError(path, f"along is 'z' or 'ray', got {along!r}")
    return intrinsics
