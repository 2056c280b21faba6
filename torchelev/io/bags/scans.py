"""Points out of messages of sensors: clouds, depth images and laser scans."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.messages.cloud import Cloud, Note
from torchelev.io.bags.messages.depth_image import CameraSettings, read_depth_image
from torchelev.io.bags.messages.laser_scan import read_laser_scan
from torchelev.io.bags.messages.livox import LIVOX, read_livox
from torchelev.io.bags.point_cloud import read_points

LIDARS = ("sensor_msgs/msg/PointCloud2", *LIVOX)  # in three dimensions
CLOUDS = (*LIDARS, "sensor_msgs/msg/LaserScan")
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")


class Scan(NamedTuple):
    """The points that a sensor measured."""

    frame: str  #: of the points
    stamp: float  #: [s]
    points: NDArray[np.float32]  #: (N, 3) [m]; NaN where there is no return
    times: NDArray[np.float64] | None  #: (N,) [s] of each point from the stamp; None: all at once
    notes: tuple[Note, ...] = ()  #: notes on data that are not used, or are interpreted differently from the message
    colors: NDArray[np.float32] | None = None  #: (N, 3) from 0 to 1; None: none, or not asked for


def read_scan(
    message: Any, camera: CameraSettings | Any = None, period: float | None = None, colors: bool = False
) -> Scan:
    """Return the points of a message.

    Args:
        message: a PointCloud2, a LaserScan, Livox's CustomMsg, or with `camera` an Image or CompressedImage of depth:
            16UC1 [mm], 32FC1 [m], or a PNG of 16 bits or RVL: [mm], or 32FC1 quantised by compressedDepth.
        camera: the CameraInfo of a depth image, or all that is known about its topic.
        period: [s] between two messages of the topic; None: unknown.
        colors: read the colours of the points, too, if they have any.

    Raises:
        CloudError: the message contradicts itself, or is of another kind.
    """
    stamp, frame = stamp_of(message.header), clean(message.header.frame_id)
    cloud = _read(message, stamp, camera, period, colors)
    T = getattr(message, "T_frame_points", None)  # of Foxglove's messages
    points = cloud.points if T is None else (cloud.points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    return Scan(frame, stamp, points, cloud.times, cloud.notes, cloud.colors)


def _read(message: Any, stamp: float, camera: CameraSettings | Any, period: float | None, colors: bool) -> Cloud:
    if camera is not None:
        return read_depth_image(message, camera if isinstance(camera, CameraSettings) else CameraSettings(camera))
    if hasattr(message, "ranges"):
        return read_laser_scan(message, period)
    return read_livox(message, stamp) if hasattr(message, "timebase") else read_points(message, stamp, period, colors)


def stamp_of(header: Any) -> float:
    """Return the time of a header [s]."""
    stamp = header.stamp
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def clean(frame: str) -> str:
    """Return a frame's name as tf2 writes it, without a slash in front."""
    return frame.lstrip("/")
