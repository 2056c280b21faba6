"""Points out of messages of sensors: clouds, depth images and laser scans."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.depth_png import decode_depth
from torchelev.io.bags.point_cloud import CloudError, read_points

CLOUDS = ("sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/LaserScan")
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_UNITS = {"16UC1": 1e-3, "mono16": 1e-3, "32FC1": 1.0}  # [m] of depth, by encoding


class Scan(NamedTuple):
    """What a sensor measured."""

    frame: str  #: of the points
    stamp: float  #: [s]
    points: NDArray[np.float32]  #: (N, 3) [m]; NaN where there is no return
    times: NDArray[np.float64] | None  #: (N,) [s] of each point from the stamp; None: all at once
    note: str = ""  #: what is not used of the message


def read_scan(message: Any, camera: Any = None) -> Scan:
    """Return the points of a message.

    Args:
        message: a PointCloud2, a LaserScan, or with `camera` an Image or CompressedImage of depth: 16UC1 [mm], 32FC1
            [m], or a PNG of 16 bits: [mm], or 32FC1 quantised by compressedDepth.
        camera: the CameraInfo of a depth image.

    Raises:
        CloudError: the message contradicts itself, or is of another kind.
    """
    stamp, frame = stamp_of(message.header), clean(message.header.frame_id)
    if camera is not None:
        return Scan(frame, stamp, _read_image(message, camera), None)
    if hasattr(message, "ranges"):
        return _read_laser_scan(message, frame, stamp)
    cloud = read_points(message, stamp)
    return Scan(frame, stamp, *cloud)


def stamp_of(header: Any) -> float:
    """Return the time of a header [s]."""
    stamp = header.stamp
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def clean(frame: str) -> str:
    """Return a frame's name as tf2 writes it, without a slash in front."""
    return frame.lstrip("/")


def _read_laser_scan(message: Any, frame: str, stamp: float) -> Scan:
    ranges = np.asarray(message.ranges, dtype=np.float64)
    angle = message.angle_min + message.angle_increment * np.arange(len(ranges))
    valid = (ranges >= message.range_min) & (ranges <= message.range_max)
    distance = np.where(valid, ranges, np.nan)
    points = np.stack([distance * np.cos(angle), distance * np.sin(angle), 0 * distance], -1).astype(np.float32)
    times = message.time_increment * np.arange(len(ranges)) if message.time_increment > 0 else None
    return Scan(frame, stamp, points, times)


def _read_image(message: Any, camera: Any) -> NDArray[np.float32]:
    """Return the points (h * w, 3) [m] of a depth image, in the optical frame."""
    import torch

    from torchelev.inputs.clouds import depth_to_points

    depth = _decode_compressed(message) if hasattr(message, "format") else _decode_raw(message)
    matrix = np.asarray(getattr(camera, "K", None) if hasattr(camera, "K") else camera.k, dtype=np.float64)
    if (depth.shape[1], depth.shape[0]) != (camera.width, camera.height):
        actual, told = f"{depth.shape[1]} x {depth.shape[0]}", f"{camera.width} x {camera.height}"
        raise CloudError(f"the depth image has {actual} pixels, and its CameraInfo {told}")
    if not matrix.reshape(3, 3)[0, 0] > 0:
        raise CloudError("the CameraInfo holds no calibration: its focal length is not positive")
    K = torch.tensor(matrix.reshape(3, 3), dtype=torch.float32)
    return depth_to_points(torch.from_numpy(depth)[None], K)[0].numpy()


def _decode_raw(message: Any) -> NDArray[np.float32]:
    """Return an Image's depth (h, w) [m]."""
    if message.encoding not in _UNITS:
        raise CloudError(f"images of {message.encoding} hold no depth; 16UC1 and 32FC1 do")
    kind = np.dtype((">" if message.is_bigendian else "<") + ("f4" if message.encoding == "32FC1" else "u2"))
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    if step < width * kind.itemsize or len(data) < step * (height - 1) + width * kind.itemsize:
        raise CloudError(f"the image has {len(data)} bytes, too few for {height} rows of {step}")
    image = np.ndarray((height, width), kind, buffer=data, strides=(step, kind.itemsize))
    return image.astype(np.float32) * np.float32(_UNITS[message.encoding])


def _decode_compressed(message: Any) -> NDArray[np.float32]:
    """Return a CompressedImage's depth (h, w) [m]."""
    return decode_depth(bytes(np.asarray(message.data, dtype=np.uint8)), message.format)
