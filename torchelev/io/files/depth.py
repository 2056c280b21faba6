"""Read depth images: PNG of 16 bits, and arrays as simulators write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchelev.io.errors import RecordingError
from torchelev.io.files.arrays import is_cloud, load_npy, load_npz
from torchelev.io.files.intrinsics import Intrinsics, check_size, read_intrinsics

__all__ = ["Intrinsics", "read_depth", "read_depth_points", "read_intrinsics"]

_NAMES = ("depth", "distance_to_image_plane", "distance_to_camera")
_ALONG_RAY = "distance_to_camera"  # in file names of Isaac Sim's Replicator: along each pixel's ray
_FAR = 200.0  # [m] a median depth beyond which values are not metres


def read_depth(path: str | Path, depth_scale: float = 0.001, float_scale: float = 1.0) -> NDArray[np.float32]:
    """Read a depth image: a 16-bit PNG, or a `.npy` or `.npz` array (H, W).

    Args:
        path: the file.
        depth_scale: [m] per unit of an image of integers: 0.001 for millimetres.
        float_scale: [m] per unit of an array of floats.

    Returns:
        Depth (H, W) [m], 0 where there was no return.

    Raises:
        RecordingError: the file is missing, cut short or no depth image.
    """
    path = Path(path)
    if not path.is_file():
        raise RecordingError(path, "no such file")
    units = _read_png(path) if path.suffix.lower() == ".png" else _read_array(path)
    if units.dtype.kind in "iu":
        return units.astype(np.float32) * np.float32(depth_scale)
    depth = np.where(np.isfinite(units) & (units > 0), units, 0).astype(np.float32) * np.float32(float_scale)
    median = float(np.median(depth[depth > 0])) if depth.any() else 0.0
    if median > _FAR:
        problem = f"the median depth is {median:.4g} m"
        raise RecordingError(path, problem, "give the metres per unit with --depth-scale, 0.001 for millimetres")
    return depth


def read_depth_points(path: Path, camera: Intrinsics) -> NDArray[np.float32]:
    """Read a depth image as points (H * W, 3) [m] in the camera frame, whose axes the camera names."""
    import torch

    from torchelev.inputs.clouds import depth_to_points

    depth = read_depth(path, camera.depth_scale, camera.float_scale)
    check_size(path, camera, depth.shape)
    matrix = torch.from_numpy(camera.matrix).float()
    along = "ray" if _ALONG_RAY in path.stem else camera.along
    return depth_to_points(torch.from_numpy(depth)[None], matrix, along=along, frame=camera.axes)[0].numpy()


def _read_png(path: Path) -> NDArray:
    import cv2

    # OpenCV silently fills the missing part of a truncated PNG with zeros; a complete one ends with an IEND chunk.
    if b"IEND" not in path.read_bytes()[-16:]:
        raise RecordingError(path, "cut short or not a PNG", "copy the file again")
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise RecordingError(path, "cannot be decoded", "copy the file again")
    if image.dtype != np.uint16 or image.ndim != 2:
        problem = f"expected one 16-bit channel, got {image.dtype} {image.shape}"
        raise RecordingError(path, problem, "save depth in millimetres as uint16")
    return image


def _read_array(path: Path) -> NDArray:
    array = load_npy(path) if path.suffix.lower() == ".npy" else load_npz(path, _NAMES)[0]
    if is_cloud(array) and not (array.ndim == 3 and array.shape[0] == 1):
        raise RecordingError(path, f"holds a point cloud {array.shape}, not depth (H, W)", "drop --intrinsics")
    image = array.reshape([size for size in array.shape if size != 1]) if array.ndim > 2 else array
    if image.ndim != 2 or image.dtype.kind not in "fiu" or image.dtype.itemsize < 2:
        problem = f"expected depth (H, W) as floats in metres or integers of 16 bits, got {array.dtype} {array.shape}"
        raise RecordingError(path, problem, "save one channel")
    return image
