"""Read point clouds; the file's suffix tells the format."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchelev.frames import transform
from torchelev.io.errors import RecordingError
from torchelev.io.folders.layout import FileLayout, read_bin


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
        return np.ascontiguousarray(reader(path, layout or FileLayout()), dtype=np.float32)
    except RecordingError:
        raise
    except Exception as error:  # for a damaged file, parsers raise all kinds of exceptions
        detail = str(error) or type(error).__name__
        raise RecordingError(path, f"cannot be read ({detail})", "copy or export it again") from error


def _read_bin(path: Path, layout: FileLayout) -> NDArray:
    return read_bin(path, layout.bin)


def _read_npy(path: Path, layout: FileLayout) -> NDArray:
    try:
        array = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:  # NumPy's own message blames pickle, which would mislead
        raise RecordingError(path, "cut short or not a .npy file", "save it again with numpy.save") from error
    return _columns(path, array)


def _read_npz(path: Path, layout: FileLayout) -> NDArray:
    try:
        with zipfile.ZipFile(path) as archive:
            keys = [name.removesuffix(".npy") for name in archive.namelist()]
        key = _choose_key(path, keys)
        with np.load(path, allow_pickle=False) as arrays:
            array = arrays[key]
    except RecordingError:
        raise
    except (zipfile.BadZipFile, ValueError, OSError, EOFError) as error:
        raise RecordingError(path, "cut short or not a .npz file", "save it again with numpy.savez") from error
    return _columns(path, array)


def _choose_key(path: Path, keys: list[str]) -> str:
    for key in ("points", "xyz"):
        if key in keys:
            return key
    if len(keys) != 1:
        raise RecordingError(path, f"no array 'points' among {keys}", "name the (N, 3) array 'points'")
    return keys[0]


def _columns(path: Path, array: NDArray) -> NDArray:
    """Return x, y, z (N, 3) of an array (..., C >= 3) or of a structured array with these fields."""
    if array.dtype.names:
        return _fields(path, array)
    if array.ndim < 2 or array.shape[-1] < 3 or array.dtype.kind not in "fiu":
        problem = f"expected numbers (N, 3), got {array.dtype} {array.shape}"
        raise RecordingError(path, problem, "save one row x y z per point")
    if array.ndim == 2 and array.shape[0] in (3, 4) and array.shape[1] > 16:
        raise RecordingError(path, f"expected (N, 3), got {array.shape}", "save it transposed, one row per point")
    return array[..., :3].reshape(-1, 3)


def _fields(path: Path, array: NDArray) -> NDArray:
    missing = {"x", "y", "z"} - set(array.dtype.names or ())
    if missing:
        raise RecordingError(path, f"no field {' '.join(sorted(missing))}", "the cloud needs fields x, y and z")
    return np.stack([np.asarray(array[name]).ravel() for name in "xyz"], axis=-1)


def _read_ply(path: Path, layout: FileLayout) -> NDArray:
    import plyfile

    try:
        data = plyfile.PlyData.read(path)
    except (plyfile.PlyParseError, UnicodeDecodeError, ValueError) as error:
        raise RecordingError(path, f"cut short or not a .ply file ({error})", "export it again") from error
    if "vertex" not in data:
        raise RecordingError(path, "no element 'vertex'", "the cloud needs vertices with x, y and z")
    return _fields(path, data["vertex"].data)


def _read_pcd(path: Path, layout: FileLayout) -> NDArray:
    from pypcd4 import PointCloud

    try:
        cloud = PointCloud.from_path(path)
        num_points = cloud.metadata.points
    except Exception as error:  # raised by pypcd4, NumPy, pydantic or lzf, depending on what is damaged
        detail = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RecordingError(path, f"cut short or not a .pcd file ({detail})", "export it again") from error
    if len(cloud.pc_data) != num_points:
        raise RecordingError(path, f"cut short: {len(cloud.pc_data)} of {num_points} points", "copy the file again")
    return _to_sensor_frame(path, _fields(path, cloud.pc_data), cloud.metadata.viewpoint, layout.pcd_frame)


def _to_sensor_frame(path: Path, points: NDArray, viewpoint: tuple[float, ...], frame: str | None) -> NDArray:
    """Return points (N, 3) in the sensor frame.

    VIEWPOINT is the sensor's pose, but programs differ on whether the points are in its frame or in the sensor's.
    """
    position, quat_wxyz = np.array(viewpoint[:3]), np.array(viewpoint[3:])
    is_identity = np.allclose(position, 0) and np.allclose(np.abs(quat_wxyz), [1, 0, 0, 0])
    if is_identity or frame == "sensor":
        return points
    if frame is None:
        numbers = " ".join(f"{v:g}" for v in viewpoint)
        problem = f"VIEWPOINT {numbers}: the points may be in the sensor's frame or in the frame of this pose"
        raise RecordingError(path, problem, "say which with --pcd-frame sensor or --pcd-frame viewpoint")
    norm = np.linalg.norm(quat_wxyz)
    if not abs(norm - 1) < 0.02:
        raise RecordingError(path, f"VIEWPOINT's quaternion has length {norm:g}, not 1", "use --pcd-frame sensor")
    T_view_sensor = transform(position, quat_wxyz / norm).numpy()
    return (points - position) @ T_view_sensor[:3, :3]


_READERS: dict[str, Callable[[Path, FileLayout], NDArray]] = {
    ".bin": _read_bin,
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".pcd": _read_pcd,
    ".ply": _read_ply,
}
CLOUD_SUFFIXES = tuple(_READERS)
