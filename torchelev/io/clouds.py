"""Read one point cloud, format by extension, as (N, 3) float32 [m] in the sensor frame."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchelev.io.errors import RecordingError
from torchelev.io.layout import FileLayout, read_bin


def read_cloud(path: str | Path, layout: FileLayout | None = None) -> NDArray[np.float32]:
    """Read a cloud: `.bin` (KITTI), `.npy`, `.npz`, `.ply` or `.pcd` -> (N, 3) float32 [m].

    Columns or fields beyond x, y, z are dropped; points with NaN are kept, the map ignores them. `layout` says how
    numbers are laid out that a file does not describe. Raises RecordingError for an unknown extension, for a file
    that is missing, cut short or not what its name says, and for one that looks like another layout.
    """
    path = Path(path)
    reader = CLOUD_READERS.get(path.suffix.lower())
    if reader is None:
        raise RecordingError(path, f"unknown format '{path.suffix}'", f"convert it to one of {known_formats()}")
    if not path.is_file():
        raise RecordingError(path, "no such file")
    try:
        if path.stat().st_size == 0:
            raise RecordingError(path, "the file is empty", "copy it again or remove it together with its pose")
        return np.ascontiguousarray(reader(path, layout or FileLayout()), dtype=np.float32)
    except RecordingError:
        raise
    except Exception as error:  # parsers of damaged files raise what they like
        detail = str(error) or type(error).__name__
        raise RecordingError(path, f"cannot be read ({detail})", "copy or export it again") from error


def known_formats() -> str:
    """Name the suffixes of the clouds that can be read."""
    return " ".join(sorted(CLOUD_READERS))


def _read_bin(path: Path, layout: FileLayout) -> NDArray:
    return read_bin(path, layout.bin)


def _read_npy(path: Path, layout: FileLayout) -> NDArray:
    # numpy takes any junk for a pickle and says so: its message would mislead.
    try:
        array = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise RecordingError(path, "cut short or no .npy file", "save it again with numpy.save") from error
    return _columns(path, array)


def _read_npz(path: Path, layout: FileLayout) -> NDArray:
    try:
        with zipfile.ZipFile(path) as archive:
            keys = [name.removesuffix(".npy") for name in archive.namelist()]
        key = _cloud_key(path, keys)
        with np.load(path, allow_pickle=False) as arrays:
            array = arrays[key]
    except RecordingError:
        raise
    except (zipfile.BadZipFile, ValueError, OSError, EOFError) as error:
        raise RecordingError(path, "cut short or no .npz file", "save it again with numpy.savez") from error
    return _columns(path, array)


def _cloud_key(path: Path, keys: list[str]) -> str:
    for key in ("points", "xyz"):
        if key in keys:
            return key
    if len(keys) != 1:
        raise RecordingError(path, f"no array 'points' among {keys}", "name the (N, 3) array 'points'")
    return keys[0]


def _columns(path: Path, array: NDArray) -> NDArray:
    """(..., C >= 3) or structured with x, y, z -> (N, 3)."""
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
        raise RecordingError(path, f"cut short or no .ply file ({error})", "export it again") from error
    if "vertex" not in data:
        raise RecordingError(path, "no element 'vertex'", "the cloud needs vertices with x, y and z")
    return _fields(path, data["vertex"].data)


def _read_pcd(path: Path, layout: FileLayout) -> NDArray:
    from pypcd4 import PointCloud

    # pypcd4 leaves checking to numpy, pydantic and lzf: what a broken file raises depends on where it breaks.
    try:
        cloud = PointCloud.from_path(path)
        count = cloud.metadata.points
    except Exception as error:
        detail = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RecordingError(path, f"cut short or no .pcd file ({detail})", "export it again") from error
    if len(cloud.pc_data) != count:
        raise RecordingError(path, f"cut short: {len(cloud.pc_data)} of {count} points", "copy the file again")
    return _from_viewpoint(path, _fields(path, cloud.pc_data), cloud.metadata.viewpoint, layout.pcd_frame)


def _from_viewpoint(path: Path, points: NDArray, viewpoint: tuple[float, ...], frame: str | None) -> NDArray:
    """Return points (N, 3) in the sensor's frame; where VIEWPOINT says something, programs differ in what it is."""
    position, quat_wxyz = np.array(viewpoint[:3]), np.array(viewpoint[3:])
    is_identity = np.allclose(position, 0) and np.allclose(np.abs(quat_wxyz), [1, 0, 0, 0])
    if is_identity or frame == "sensor":
        return points
    problem = f"VIEWPOINT {' '.join(f'{v:g}' for v in viewpoint)}: are the points in the sensor's frame, or in its?"
    if frame is None:
        raise RecordingError(path, problem, "say which with --pcd-frame sensor or --pcd-frame viewpoint")
    norm = np.linalg.norm(quat_wxyz)
    if not abs(norm - 1) < 0.02:
        raise RecordingError(path, f"VIEWPOINT's quaternion has length {norm:g}, not 1", "use --pcd-frame sensor")
    w, x, y, z = quat_wxyz / norm
    rotation = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    return (points - position) @ rotation


CLOUD_READERS: dict[str, Callable[[Path, FileLayout], NDArray]] = {
    ".bin": _read_bin,
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".pcd": _read_pcd,
    ".ply": _read_ply,
}
