"""Read point clouds in the format of the file's suffix."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchelev.io.errors import RecordingError
from torchelev.io.files.arrays import CloudFile, from_fields, read_npy, read_npz
from torchelev.io.files.layout import FileLayout, read_bin
from torchelev.io.files.pcd import read_pcd


def read_cloud(path: str | Path, layout: FileLayout | None = None) -> NDArray[np.float32]:
    """Read a point cloud: `.bin` (KITTI), `.npy`, `.npz`, `.ply` or `.pcd`.

    Args:
        path: the file.
        layout: what the file leaves open; None: see `FileLayout`.

    Returns:
        Points x, y, z (N, 3) [m] in the sensor frame. Other columns and fields are dropped, points with NaN are kept.

    Raises:
        RecordingError: unknown suffix, or a file that is missing, damaged or contradicts its layout.
    """
    return read_cloud_file(path, layout).points


def read_cloud_file(path: str | Path, layout: FileLayout | None = None) -> CloudFile:
    """Read a point cloud as `read_cloud` does, with the times of its points as the file gives them."""
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise RecordingError(
            path, f"unknown format '{path.suffix}'", f"convert it to one of {' '.join(CLOUD_SUFFIXES)}"
        )
    if not path.is_file():
        raise RecordingError(path, "no such file")
    try:
        if path.stat().st_size == 0:
            raise RecordingError(path, "the file is empty", "copy it again or remove it together with its pose")
        cloud = reader(path, layout or FileLayout())
        return cloud._replace(points=np.ascontiguousarray(cloud.points, dtype=np.float32))
    except RecordingError:
        raise
    except Exception as error:  # for a damaged file, parsers raise all kinds of exceptions
        detail = str(error) or type(error).__name__
        raise RecordingError(path, f"cannot be read ({detail})", "copy or export it again") from error


def _read_bin(path: Path, layout: FileLayout) -> CloudFile:
    rows = read_bin(path, layout.bin)
    return CloudFile(rows[:, :3], others=rows[:, 3:])


def _read_ply(path: Path, layout: FileLayout) -> CloudFile:
    import plyfile

    try:
        data = plyfile.PlyData.read(path)
    except (plyfile.PlyParseError, UnicodeDecodeError, ValueError) as error:
        raise RecordingError(path, f"cut short or not a .ply file ({error})", "export it again") from error
    if "vertex" not in data:
        raise RecordingError(path, "no element 'vertex'", "the cloud needs vertices with x, y and z")
    return from_fields(path, data["vertex"].data)


_READERS: dict[str, Callable[[Path, FileLayout], CloudFile]] = {
    ".bin": _read_bin,
    ".npy": lambda path, layout: read_npy(path),
    ".npz": lambda path, layout: read_npz(path),
    ".pcd": lambda path, layout: read_pcd(path, layout.pcd_frame),
    ".ply": _read_ply,
}
CLOUD_SUFFIXES = tuple(_READERS)
