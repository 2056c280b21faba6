"""How to read the depth images of a topic: calibration, unit, axes."""

from __future__ import annotations

import math
import re

import numpy as np
from numpy.typing import NDArray

from torchelev.errors import require
from torchelev.io.bags.bag import Bag, Topic
from torchelev.io.bags.messages.depth_image import CameraSettings
from torchelev.io.bags.topics import BagRequest, name_topics
from torchelev.io.errors import RecordingError

CAMERA = "sensor_msgs/msg/CameraInfo"
_UNITS = re.compile(r"option/depth[_ ]units/value$", re.IGNORECASE)  # as librealsense records a sensor's options

_UPWARDS = 0.7  # height of the end of an optical axis of 1 m, from which on a camera looks up


def find_cameras(bag: Bag, types: dict[str, Topic], request: BagRequest) -> dict[str, CameraSettings]:
    """Return how the depth images of each requested topic are read.

    Raises:
        RecordingError: a topic has no CameraInfo, or that one holds no message.
    """
    depths, infos, scale = request.depths, request.camera_infos, request.depth_scale
    rule = "must be positive and finite"
    require(scale is None or 0 < scale < math.inf, "--depth-scale", rule, scale, "give metres per unit")
    if infos and len(infos) not in (1, len(depths)):
        reason = f"{len(infos)} topics of CameraInfo are given for {len(depths)} topics of depth images"
        raise RecordingError(bag.path, reason, "give --camera-info once, or once for each --depth, in their order")
    named = list(infos) * (len(depths) if len(infos) == 1 else 1) or [
        camera_info(bag, types, d, "--camera-info") for d in depths
    ]
    cameras = {}
    for depth, info in zip(depths, named, strict=True):
        if info not in types or types[info].type != CAMERA:
            kind = types[info].type if info in types else "not in the bag"
            raise RecordingError(bag.path, f"--camera-info {info} is {kind}", f"such topics are {_infos(types)}")
        message = next(bag.read([info]), None)
        if message is None:
            raise RecordingError(bag.path, f"{info} holds no message", "record it with the images")
        unit = _recorded_scale(bag, types, depth) if scale is None else scale
        cameras[depth] = CameraSettings(message.data, depth, unit, request.depth_axes)
    return cameras


def doubt_axes(camera: CameraSettings | None, frame: str, T_map_sensor: NDArray[np.float64]) -> str:
    """Return a sentence if a camera would look at the sky: its frame has other axes than an optical one; else ""."""
    if camera is None or camera.axes != "optical" or T_map_sensor[2, 2] < _UPWARDS:
        return ""
    return f"a camera with the axes of {frame} looks up: if its x axis points forward, give --depth-axes forward"


def camera_info(bag: Bag, types: dict[str, Topic], images: str, option: str) -> str:
    """Return the topic of CameraInfo that belongs to a topic of images by its name; `option` names another."""
    # compressedDepth adds a level: /camera/depth/image_rect_raw/compressedDepth; librealsense: .../Depth_0/image/data
    folders = [images.rsplit("/", level)[0] for level in (1, 2)]
    names = [f"{folders[0]}/camera_info", f"{folders[1]}/camera_info", f"{folders[1]}/info/camera_info"]
    found = next((name for name in names if name in types), None)
    if found is None:
        hint = f"name one with {option}; topics of CameraInfo are {_infos(types)}"
        raise RecordingError(bag.path, f"{images} has no camera_info beside it", hint)
    return found


def _infos(types: dict[str, Topic]) -> str:
    return name_topics([topic for topic in types.values() if topic.type == CAMERA])


def _recorded_scale(bag: Bag, types: dict[str, Topic], depth: str) -> float | None:
    """Return the metres per unit of depth [m] that librealsense recorded for the sensor of a topic; None: none."""
    sensor = depth.split("/")[1:3]  # /device_0/sensor_0/Depth_0/image/data
    topic = next((name for name in types if name.split("/")[1:3] == sensor and _UNITS.search(name)), None)
    message = None if topic is None else next(bag.read([topic]), None)
    if message is None:
        return None
    try:
        scale = float(message.data.data)
    except ValueError:
        scale = 0.0
    if not 0 < scale < 1:
        reason = f"{topic} says {message.data.data!r}, which is no unit of depth"
        raise RecordingError(bag.path, reason, "give the metres per unit by --depth-scale")
    return scale
