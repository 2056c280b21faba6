"""Read poses: KITTI and TUM files, distinguished by their number of columns, and single transforms."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.frames import transform_xyzw
from torchelev.io.errors import RecordingError
from torchelev.io.files.layout import XYZW_COLUMNS, FileLayout, detect_quaternion_order, stamps_to_seconds

_KITTI_COLUMNS = 12
_TOLERANCE = 0.02  # rotations rounded to three decimals are off by about 0.001; larger errors have other causes
_INDEXED = {13: 12, 17: 16, 9: 8}  # columns with an index before the pose, and without it
_COLUMNS = (8, 9, 12, 13, 16, 17)
_POSE_HINT = (
    "expected 12 or 16 numbers per line (KITTI: the pose, row by row) or 8 (TUM: t x y z qx qy qz qw), with an index "
    "before them or without"
)
_TRANSFORM_HINT = "give 12 numbers (the upper 3x4 of T_base_sensor, row by row) or a file with them"
_NOT_A_ROTATION = "the 3x3 part is not a rotation matrix, or is mirrored"


class Poses(NamedTuple):
    """Poses of a sensor in the map frame."""

    T_map_sensor: NDArray[np.float64]  #: (T, 4, 4), translation in [m]
    times: NDArray[np.float64] | None  #: (T,) [s]; None if the file has no timestamps


def read_poses(path: str | Path, layout: FileLayout | None = None) -> Poses:
    """Read a pose file, one pose per line: 12 or 16 numbers (KITTI) or 8 (TUM), an index before them or none.

    Blank lines, lines that start with `#` and a first line of names are skipped; commas count as spaces. Each rotation
    is replaced by the nearest rotation matrix, because files are often rounded to a few decimals.

    Args:
        path: the file.
        layout: order of quaternions and unit of timestamps; None: see `FileLayout`.

    Returns:
        The poses.

    Raises:
        RecordingError: a line is not a pose, or quaternions look like w x y z; the message names the line.
    """
    path, layout = Path(path), layout or FileLayout()
    text = _read_text(path)
    lines, rows = _read_rows(path, text)
    if rows.shape[1] in _INDEXED:
        rows = _drop_index(path, lines, rows)
    if rows.shape[1] == 16:
        is_last = np.abs(rows[:, 12:] - [0, 0, 0, 1]).max(axis=1) < 1e-6
        _require_lines(path, lines, is_last, "the last row is not 0 0 0 1")
    if rows.shape[1] >= _KITTI_COLUMNS:
        T_map_sensor = np.tile(np.eye(4), (len(rows), 1, 1))
        T_map_sensor[:, :3] = rows[:, :_KITTI_COLUMNS].reshape(-1, 3, 4)
        return Poses(_make_rigid(path, lines, T_map_sensor), None)
    comments = "\n".join([*(line.partition("#")[2] for line in text.splitlines()), _header(text)])
    order = detect_quaternion_order(path, comments, rows[:, 4:], layout.quaternions)
    quat_xyzw = rows[:, 4:][:, XYZW_COLUMNS[order]]
    norm = np.linalg.norm(quat_xyzw, axis=1, keepdims=True)
    _require_lines(path, lines, np.abs(norm[:, 0] - 1) <= _TOLERANCE, "the quaternion is not of length 1")
    T_map_sensor = transform_xyzw(rows[:, 1:4], quat_xyzw / norm).numpy()
    return Poses(_make_rigid(path, lines, T_map_sensor), stamps_to_seconds(rows[:, 0], layout.time_unit))


def read_transform(text_or_path: str | Path) -> NDArray[np.float64]:
    """Read one rigid transform.

    Args:
        text_or_path: 12 or 16 numbers, row by row, or a file with them, or a YAML file with a key `T_base_sensor`.

    Returns:
        The transform (4, 4), with the nearest rotation matrix.

    Raises:
        RecordingError: there are not as many numbers, or they are not a rigid transform.
    """
    numbers = _parse_numbers(str(text_or_path))
    if numbers is None:
        numbers = _read_numbers(Path(text_or_path))
    if len(numbers) not in (12, 16):
        raise RecordingError(text_or_path, f"holds {len(numbers)} numbers", _TRANSFORM_HINT)
    result = np.eye(4)
    result[:3] = np.array(numbers[:12]).reshape(3, 4)
    rotation = _nearest_rotation(result[:3, :3])
    if np.abs(result[:3, :3] - rotation).max() > _TOLERANCE:
        raise RecordingError(text_or_path, _NOT_A_ROTATION, _TRANSFORM_HINT)
    result[:3, :3] = rotation
    return result


def _read_rows(path: Path, text: str) -> tuple[list[int], NDArray[np.float64]]:
    """Return line numbers (T,) and the numbers on these lines (T, C)."""
    lines = [(number, line.split("#")[0]) for number, line in enumerate(text.splitlines(), start=1)]
    if _header(text):
        lines = lines[1:]
    rows = {number: _parse_line(path, number, line) for number, line in lines if line.strip()}
    if not rows:
        raise RecordingError(path, "holds no pose", _POSE_HINT)
    num_columns = len(next(iter(rows.values())))
    for number, row in rows.items():
        if len(row) not in _COLUMNS:
            raise RecordingError(path, f"line {number} holds {len(row)} numbers", _POSE_HINT)
        if len(row) != num_columns:
            raise RecordingError(path, f"line {number} holds {len(row)} numbers, the lines before it {num_columns}")
    return list(rows), np.array(list(rows.values()), dtype=np.float64)


def _header(text: str) -> str:
    """Return the first line if it holds names of columns, as many as the next holds numbers; else ""."""
    first, _, rest = text.partition("\n")
    names, numbers = (line.replace(",", " ").split() for line in (first, rest.partition("\n")[0]))
    return first if len(names) == len(numbers) and all(re.match("[^\\W\\d]", name) for name in names) else ""


def _drop_index(path: Path, lines: list[int], rows: NDArray) -> NDArray[np.float64]:
    """Return rows without their first column, which must count poses."""
    index = rows[:, 0]
    counts = (index == np.round(index)) & (np.diff(index, prepend=index[0] - 1) > 0)
    _require_lines(path, lines, counts, f"of {rows.shape[1]} columns the first must count the poses")
    return rows[:, 1:]


def _read_text(path: Path) -> str:
    if not path.is_file():
        raise RecordingError(path, "no such pose file", "give one with --poses")
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise RecordingError(path, "is not a text file", _POSE_HINT) from error


def _parse_line(path: Path, number: int, line: str) -> list[float]:
    try:
        row = [float(word) for word in line.replace(",", " ").split()]
    except ValueError as error:
        raise RecordingError(path, f"line {number} holds more than numbers ({error})", _POSE_HINT) from error
    if not np.isfinite(row).all():
        raise RecordingError(path, f"line {number} holds NaN or inf", "remove the pose together with its scan")
    return row


def _make_rigid(path: Path, lines: list[int], poses: NDArray) -> NDArray[np.float64]:
    """Return the poses (T, 4, 4) with the nearest rotation matrices; refuse those that are far from one."""
    rotations = _nearest_rotation(poses[:, :3, :3])
    error = np.abs(poses[:, :3, :3] - rotations).max(axis=(1, 2))
    _require_lines(path, lines, error <= _TOLERANCE, _NOT_A_ROTATION)
    poses[:, :3, :3] = rotations
    return poses


def _nearest_rotation(matrices: NDArray) -> NDArray[np.float64]:
    """Return the rotation matrices (..., 3, 3) nearest in the Frobenius norm: U diag(1, 1, det UV') V'."""
    u, _, vt = np.linalg.svd(np.asarray(matrices, dtype=np.float64))
    u[..., :, 2] *= np.linalg.det(u @ vt)[..., None]
    return u @ vt


def _require_lines(path: Path, lines: list[int], holds: NDArray[np.bool_], problem: str) -> None:
    """Raise RecordingError for the first line (T,) where a rule does not hold."""
    if not holds.all():
        raise RecordingError(path, f"line {lines[int(holds.argmin())]}: {problem}", _POSE_HINT)


def _read_numbers(path: Path) -> list[float]:
    """Read a transform's numbers from text or YAML."""
    import yaml

    if not path.is_file():
        raise RecordingError(path, "neither numbers nor a file", _TRANSFORM_HINT)
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8-sig"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise RecordingError(path, "is neither text nor YAML", _TRANSFORM_HINT) from error
    numbers = _parse_numbers(data.get("T_base_sensor") if isinstance(data, dict) else data)
    if numbers is None:
        raise RecordingError(path, "holds no transform", _TRANSFORM_HINT)
    return numbers


def _parse_numbers(data: object) -> list[float] | None:
    """Return the numbers in text or nested lists; None if anything there is not a finite number."""
    try:
        values = data.replace(",", " ").split() if isinstance(data, str) else data
        numbers = np.array(values, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        return None
    return numbers.tolist() if np.isfinite(numbers).all() else None
