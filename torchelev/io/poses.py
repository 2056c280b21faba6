"""Read pose files: one sensor pose per line, KITTI or TUM, told apart by the number of columns."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.errors import RecordingError
from torchelev.io.layout import ORDERS, FileLayout, quaternion_order, seconds

KITTI_COLUMNS, TUM_COLUMNS = 12, 8
# Files rounded to three decimals are off by 0.001 or so; a matrix further off than this is something else.
RIGID_TOLERANCE = 0.02
FORMATS = "12 numbers a line (KITTI: the upper 3x4 of the pose) or 8 (TUM: t x y z qx qy qz qw)"

TRANSFORM = "give 12 numbers (the upper 3x4 of T_base_sensor, row by row) or a file with them"


class Poses(NamedTuple):
    """Poses of a sensor in the map frame and, where the file has them, their times."""

    T_map_sensor: NDArray[np.float64]  #: (T, 4, 4), translation in [m]
    times: NDArray[np.float64] | None  #: (T,) [s]


def read_poses(path: str | Path, layout: FileLayout | None = None) -> Poses:
    """Read a KITTI or TUM file. Blank lines and lines that start with '#' do not count; commas are spaces.

    Rotations are replaced by the nearest rotation matrix, since files rounded to a few decimals exist. `layout` says
    the order of quaternions and the unit of times. Raises RecordingError with the line number where a line is no pose,
    and for quaternions that look like w x y z.
    """
    path, layout = Path(path), layout or FileLayout()
    numbers, rows = _read_rows(path)
    if rows.shape[1] == KITTI_COLUMNS:
        matrices = rows.reshape(-1, 3, 4)
        return Poses(_rigid(path, numbers, matrices[:, :, :3], matrices[:, :, 3]), None)
    comments = "\n".join(line.partition("#")[2] for line in _text(path).splitlines())
    order = quaternion_order(path, comments, rows[:, 4:], layout.quaternions)
    rotations = _from_quaternions(path, numbers, rows[:, 4:][:, ORDERS[order]])
    return Poses(_rigid(path, numbers, rotations, rows[:, 1:4]), seconds(path, rows[:, 0], layout.time_unit))


def _read_rows(path: Path) -> tuple[list[int], NDArray[np.float64]]:
    """Line numbers (T,) and values (T, 8 or 12)."""
    lines = [(number, line.split("#")[0]) for number, line in enumerate(_text(path).splitlines(), start=1)]
    rows = {number: _numbers(path, number, line) for number, line in lines if line.strip()}
    if not rows:
        raise RecordingError(path, "holds no pose", f"expected {FORMATS}")
    columns = len(next(iter(rows.values())))
    for number, row in rows.items():
        if len(row) not in (KITTI_COLUMNS, TUM_COLUMNS):
            raise RecordingError(path, f"line {number} holds {len(row)} numbers", f"expected {FORMATS}")
        if len(row) != columns:
            raise RecordingError(path, f"line {number} holds {len(row)} numbers, the lines before it {columns}")
    return list(rows), np.array(list(rows.values()), dtype=np.float64)


def _text(path: Path) -> str:
    if not path.is_file():
        raise RecordingError(path, "no such pose file", "give one with --poses")
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise RecordingError(path, "is no text file", f"expected {FORMATS}") from error


def _numbers(path: Path, number: int, line: str) -> list[float]:
    try:
        row = [float(word) for word in line.replace(",", " ").split()]
    except ValueError as error:
        raise RecordingError(path, f"line {number} is not made of numbers ({error})", f"expected {FORMATS}") from error
    if not np.isfinite(row).all():
        raise RecordingError(path, f"line {number} holds NaN or inf", "remove the pose together with its scan")
    return row


def _from_quaternions(path: Path, numbers: list[int], quat_xyzw: NDArray) -> NDArray:
    """Rotation matrices (T, 3, 3) of (T, 4) quaternions in TUM's order x y z w."""
    norm = np.linalg.norm(quat_xyzw, axis=1)
    _refuse_first(path, numbers, np.abs(norm - 1) > RIGID_TOLERANCE, "the quaternion qx qy qz qw is not of length 1")
    x, y, z, w = (quat_xyzw / norm[:, None]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _rigid(path: Path, numbers: list[int], rotations: NDArray, translations: NDArray) -> NDArray[np.float64]:
    """Poses (T, 4, 4) with each rotation replaced by the nearest one; refuse what is no rotation."""
    nearest = nearest_rotation(rotations)
    off = np.abs(rotations - nearest).max(axis=(1, 2))
    _refuse_first(path, numbers, off > RIGID_TOLERANCE, "the 3x3 part is no rotation matrix (or a mirrored one)")
    poses = np.tile(np.eye(4), (len(rotations), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = nearest, translations
    return poses


def read_transform(text_or_path: str | Path) -> NDArray[np.float64]:
    """One transform (4, 4): 12 or 16 numbers, given as text or as a file, or YAML with a key `T_base_sensor`.

    Raises RecordingError if that is no rigid transform.
    """
    words = _words(str(text_or_path))
    if words is None:
        words = _file_words(Path(text_or_path))
    if len(words) not in (12, 16):
        raise RecordingError(text_or_path, f"holds {len(words)} numbers", TRANSFORM)
    matrix = np.array(words[:12]).reshape(3, 4)
    if np.abs(matrix[:, :3] - nearest_rotation(matrix[:, :3])).max() > RIGID_TOLERANCE:
        raise RecordingError(text_or_path, "the 3x3 part is no rotation matrix (or a mirrored one)", TRANSFORM)
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = nearest_rotation(matrix[:, :3]), matrix[:, 3]
    return transform


def _file_words(path: Path) -> list[float]:
    import yaml

    if not path.is_file():
        raise RecordingError(path, "neither numbers nor a file", TRANSFORM)
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8-sig"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise RecordingError(path, "is neither text nor YAML", TRANSFORM) from error
    words = _words(data.get("T_base_sensor") if isinstance(data, dict) else data)
    if words is None:
        raise RecordingError(path, "holds no transform", TRANSFORM)
    return words


def _words(data: object) -> list[float] | None:
    """Finite numbers in text or nested lists, or None if there is anything else."""
    try:
        split = data.replace(",", " ").split() if isinstance(data, str) else data
        words = np.array(split, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        return None
    return words.tolist() if np.isfinite(words).all() else None


def nearest_rotation(matrices: NDArray) -> NDArray[np.float64]:
    """Rotation matrices (..., 3, 3) nearest to `matrices` in the Frobenius norm: U diag(1, 1, det UV') V'."""
    u, _, vt = np.linalg.svd(np.asarray(matrices, dtype=np.float64))
    u[..., :, 2] *= np.linalg.det(u @ vt)[..., None]
    return u @ vt


def _refuse_first(path: Path, numbers: list[int], bad: NDArray[np.bool_], problem: str) -> None:
    if bad.any():
        raise RecordingError(path, f"line {numbers[int(bad.argmax())]}: {problem}", f"expected {FORMATS}")
