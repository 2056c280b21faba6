"""Foxglove's own messages, in protobuf or JSON, as the messages of ROS that they correspond to."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

FOXGLOVE = {
    "foxglove.PointCloud": "sensor_msgs/msg/PointCloud2",
    "foxglove.LaserScan": "sensor_msgs/msg/LaserScan",
    "foxglove.RawImage": "sensor_msgs/msg/Image",
    "foxglove.CompressedImage": "sensor_msgs/msg/CompressedImage",
    "foxglove.CameraCalibration": "sensor_msgs/msg/CameraInfo",
    "foxglove.FrameTransform": "tf2_msgs/msg/TFMessage",
    "foxglove.FrameTransforms": "tf2_msgs/msg/TFMessage",
    "foxglove.PoseInFrame": "geometry_msgs/msg/PoseStamped",
}
# foxglove.PackedElementField counts types otherwise than sensor_msgs/PointField.
_TYPES = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}
_NAMES = ("UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64")


def make_foxglove_decoder(name: str, encoding: str, schema: bytes) -> Callable[[bytes], Any]:
    """Return the decoder of messages of a type in `FOXGLOVE`, which makes messages of ROS.

    Args:
        name: of the type.
        encoding: "protobuf" or "json".
        schema: the definition in the file.

    Raises:
        ModuleNotFoundError: mcap-protobuf-support is missing.
    """
    convert = _CONVERT[name]
    if encoding == "json":
        return lambda raw: convert(json.loads(raw, object_hook=lambda fields: SimpleNamespace(**fields)))
    from mcap.records import Schema
    from mcap_protobuf.decoder import DecoderFactory

    decode = DecoderFactory().decoder_for("protobuf", Schema(1, schema, "protobuf", name))
    if decode is None:
        raise ValueError("it is no set of file descriptors")
    return lambda raw: convert(decode(raw))


def _cloud(message: Any) -> Any:
    fields = [
        SimpleNamespace(name=field.name, offset=getattr(field, "offset", 0), datatype=_type(field), count=1)
        for field in message.fields
    ]
    data, step = _bytes(message.data), int(message.point_stride)
    num = len(data) // step if step else 0
    return SimpleNamespace(
        header=_header(message), fields=fields, is_bigendian=False, height=1, width=num, point_step=step,
        row_step=num * step, data=data, T_frame_points=_matrix(getattr(message, "pose", None)),
    )  # fmt: skip


def _type(field: Any) -> int:
    """Return the number that ROS gives the type of a field; JSON may hold its name."""
    number = getattr(field, "type", 0)
    return _TYPES.get(_NAMES.index(number) if number in _NAMES else number, 0)


def _laser_scan(message: Any) -> Any:
    steps = max(1, len(message.ranges) - 1)
    return SimpleNamespace(
        header=_header(message), ranges=np.asarray(message.ranges, float), angle_min=message.start_angle,
        angle_increment=(message.end_angle - message.start_angle) / steps, range_min=1e-6, range_max=np.inf,
        time_increment=0.0, T_frame_points=_matrix(getattr(message, "pose", None)),
    )  # fmt: skip


def _image(message: Any) -> Any:
    return SimpleNamespace(
        header=_header(message), height=message.height, width=message.width, encoding=message.encoding, is_bigendian=0,
        step=message.step, data=_bytes(message.data),
    )  # fmt: skip


def _compressed_image(message: Any) -> Any:
    return SimpleNamespace(header=_header(message), format=message.format, data=_bytes(message.data))


def _camera(message: Any) -> Any:
    matrices = {name.lower(): np.asarray(getattr(message, name, ()), float) for name in "DKRP"}
    return SimpleNamespace(header=_header(message), height=message.height, width=message.width, **matrices)


def _transform(message: Any) -> Any:
    stamp = _stamp(message)
    inner = SimpleNamespace(translation=_vector(message.translation), rotation=_quaternion(message.rotation))
    header = SimpleNamespace(stamp=stamp, frame_id=message.parent_frame_id)
    return SimpleNamespace(header=header, child_frame_id=message.child_frame_id, transform=inner)


def _pose(message: Any) -> Any:
    pose = SimpleNamespace(position=_vector(message.pose.position), orientation=_quaternion(message.pose.orientation))
    return SimpleNamespace(header=_header(message), pose=pose)


def _header(message: Any) -> Any:
    return SimpleNamespace(stamp=_stamp(message), frame_id=message.frame_id)


def _stamp(message: Any) -> Any:
    """Return the time of a message: protobuf says seconds and nanos, JSON says sec and nsec."""
    time = getattr(message, "timestamp", None)
    seconds = getattr(time, "seconds", getattr(time, "sec", 0))
    return SimpleNamespace(sec=int(seconds), nanosec=int(getattr(time, "nanos", getattr(time, "nsec", 0))))


def _vector(vector: Any) -> Any:
    return SimpleNamespace(**{name: float(getattr(vector, name, 0.0)) for name in "xyz"})


def _quaternion(turn: Any) -> Any:
    """Return a quaternion; protobuf leaves out what is 0, so that one of zeros was not filled in."""
    x, y, z, w = (float(getattr(turn, name, 0.0)) for name in "xyzw")
    return SimpleNamespace(x=x, y=y, z=z, w=w if any((x, y, z, w)) else 1.0)


def _matrix(pose: Any) -> np.ndarray | None:
    """Return the pose (4, 4) of a cloud in its frame; None: it lies in the frame itself."""
    if pose is None:
        return None
    from torchelev.frames import transform_xyzw

    place, turn = _vector(getattr(pose, "position", None)), _quaternion(getattr(pose, "orientation", None))
    numbers = [place.x, place.y, place.z], [turn.x, turn.y, turn.z, turn.w]
    T = transform_xyzw(*(np.array([values], dtype=np.float64) for values in numbers))[0].numpy()
    return None if np.array_equal(T, np.eye(4)) else T


def _bytes(data: Any) -> bytes:
    """Return bytes; JSON holds them as text in base 64."""
    return base64.b64decode(data) if isinstance(data, str) else bytes(data)


_CONVERT: dict[str, Callable[[Any], Any]] = {
    "foxglove.PointCloud": _cloud,
    "foxglove.LaserScan": _laser_scan,
    "foxglove.RawImage": _image,
    "foxglove.CompressedImage": _compressed_image,
    "foxglove.CameraCalibration": _camera,
    "foxglove.FrameTransform": lambda message: SimpleNamespace(transforms=[_transform(message)]),
    "foxglove.FrameTransforms": lambda message: SimpleNamespace(
        transforms=[_transform(one) for one in message.transforms]
    ),
    "foxglove.PoseInFrame": _pose,
}
