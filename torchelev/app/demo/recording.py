"""The demo's walk as a bag: depth images, camera model and transforms, to try the other commands on.

Run ``torchelev demo --record drive.mcap``. Needs ``torchelev[io,bags]``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from torchelev.app.demo.walk import CAMERA, T_BASE_CAMERA, DemoWalk
from torchelev.frames import change_axes
from torchelev.frames.quaternions import to_quaternion
from torchelev.io.bags.writing import BagWriter

START = 1_700_000_000.0  # [s] since 1970, of the first scan
TOPIC, FRAME = "/camera/depth", "camera_depth_optical_frame"


def record_demo(path: str | Path, seconds: float | None = None, progress: bool = True) -> int:
    """Write the walk's depth images and poses to a new bag.

    Args:
        path: `.mcap`, `.db3` or a folder for ROS 2, `.bag` for ROS 1.
        seconds: simulated time [s] to walk; None: the whole course, about 30 s.
        progress: show a progress bar.

    Returns:
        The number of depth images.

    Raises:
        ValueError: the path has another suffix, or the time is not positive.
        FileExistsError: there is a folder of this name.
        WriteError: the path cannot be written.
        ModuleNotFoundError: rosbags is missing.
    """
    walk = DemoWalk(seconds)
    mounting = change_axes(T_BASE_CAMERA, given="forward", wanted="optical").numpy()
    with BagWriter(path) as bag:
        _write_transform(bag, START, "/tf_static", "base_link", FRAME, mounting)
        for scan in tqdm(walk.observe(), total=len(walk), desc="walking and recording", disable=not progress):
            stamp = START + scan.time
            _write_transform(bag, stamp, "/tf", "odom", "base_link", scan.T_map_base.numpy())
            _write_camera(bag, stamp)
            _write_depth(bag, stamp, scan.points[:, 0].view(CAMERA.height, CAMERA.width).numpy())
    return len(walk)


def _write_transform(bag: BagWriter, stamp: float, topic: str, parent: str, child: str, T: NDArray) -> None:
    place = bag.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", T[:3, 3].tolist(), strict=True)))
    turn = bag.make("geometry_msgs/msg/Quaternion", **dict(zip("wxyz", to_quaternion(T[:3, :3]).tolist(), strict=True)))
    inner = bag.make("geometry_msgs/msg/Transform", translation=place, rotation=turn)
    header, kind = bag.make_header(stamp, parent), "geometry_msgs/msg/TransformStamped"
    one = bag.make(kind, header=header, child_frame_id=child, transform=inner)
    bag.write(topic, "tf2_msgs/msg/TFMessage", stamp, bag.make("tf2_msgs/msg/TFMessage", transforms=[one]))


def _write_camera(bag: BagWriter, stamp: float) -> None:
    """Write the camera's model."""
    K = CAMERA.intrinsics.numpy()
    P = np.concatenate([K, np.zeros((3, 1))], 1)
    arrays: dict[str, ArrayLike] = {"d": np.zeros(5), "k": K.ravel(), "r": np.eye(3).ravel(), "p": P.ravel()}
    named: dict[str, Any] = {name.upper() if bag.ros == 1 else name: value for name, value in arrays.items()}
    region = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0)
    named["roi"] = bag.make("sensor_msgs/msg/RegionOfInterest", **region, do_rectify=False)
    kind, model = "sensor_msgs/msg/CameraInfo", {"distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0}
    size = {"height": CAMERA.height, "width": CAMERA.width}
    message = bag.make(kind, header=bag.make_header(stamp, FRAME), **size, **model, **named)
    bag.write(f"{TOPIC}/camera_info", kind, stamp, message)


def _write_depth(bag: BagWriter, stamp: float, depth: NDArray) -> None:
    """Write a depth image (H, W) [m] in millimetres, 0 where nothing was seen."""
    image = np.round(1e3 * np.nan_to_num(depth)).clip(0, 65535).astype("<u2")
    size = {"height": image.shape[0], "width": image.shape[1], "step": 2 * image.shape[1], "is_bigendian": 0}
    kind, data = "sensor_msgs/msg/Image", np.frombuffer(image.tobytes(), np.uint8)
    message = bag.make(kind, header=bag.make_header(stamp, FRAME), encoding="16UC1", data=data, **size)
    bag.write(f"{TOPIC}/image_rect_raw", kind, stamp, message)
