"""A drive along stairs with lidar, depth camera, transforms and odometry, written as a bag of any format."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from torchelev.frames import interpolate_poses
from torchelev.sim import Box, DepthCamera, Lidar, Scene
from torchelev.sim.poses import pose

START = 1_700_000_000.0  # [s] since 1970
SCANS, PERIOD, PARTS = 6, 0.1, 12  # parts: casts of a scan, each from its own pose
LIDAR, CAMERA = Lidar(rings=24, azimuths=240), DepthCamera(width=32, height=24)
COVARIANCE = np.diag([1e-4, 1e-4, 4e-4, 1e-6, 1e-6, 1e-4])
FORMATS = {"ros1": "drive.bag", "sqlite3": "drive", "mcap": "drive"}
CLOUD, DEPTH, ODOM = "/lidar/points", "/camera/depth/image_raw", "/odom"


def _step(k):
    return Box(low=(1.02 + 0.3 * k, -3.0, -1.0), high=(9.0, 3.0, 0.1 * (k + 1)), grounded=True)


SCENE = Scene(boxes=tuple(_step(k) for k in range(4)))
T_BASE_LIDAR = pose(torch.tensor([0.1, 0.0, 0.4], dtype=torch.float64), 0.0)
# Optical axes: x right, y down, z forward; 20 degrees down.
_FORWARD = torch.tensor(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
).double()
T_BASE_CAMERA = pose(torch.tensor([0.2, 0.0, 0.3], dtype=torch.float64), 0.0, 0.35) @ _FORWARD


class Scan(NamedTuple):
    """What a sensor measures."""

    stamp: float  # [s]
    points: np.ndarray  # (N, 3) [m]
    times: np.ndarray | None  # (N,) [s] from the stamp
    T_map_sensor: np.ndarray
    T_map_base: np.ndarray


class Drive(NamedTuple):
    """All that is recorded."""

    stamps: np.ndarray  # (K,) [s] of the poses
    bases: np.ndarray  # (K, 4, 4)
    clouds: list[Scan]
    depths: list[tuple[Scan, np.ndarray]]  # and the images (h, w) [m]


def base_at(time):
    """The robot drives ahead at 0.5 m/s and turns by 0.4 rad/s."""
    t = torch.as_tensor(time, dtype=torch.float64) - START
    place = torch.stack([0.5 * t - 0.2, 0.05 * t, 0.3 + 0 * t], -1)
    return pose(place, 0.4 * t)


@functools.cache
def drive() -> Drive:
    stamps = START + np.arange(-0.3, SCANS * PERIOD + 0.3, 0.02)
    bases = base_at(stamps).numpy()
    return Drive(
        stamps,
        bases,
        [_spin(START + PERIOD * k) for k in range(SCANS)],
        [_look(START + 0.05 + PERIOD * k) for k in range(SCANS)],
    )


def _spin(stamp: float) -> Scan:
    """A scan that ends at its stamp, as the robot moves."""
    azimuth = torch.atan2(LIDAR.directions[:, 1], LIDAR.directions[:, 0]) / (2 * np.pi) + 0.5
    part = (azimuth * PARTS).floor().clamp(max=PARTS - 1)
    times = ((part + 1) / PARTS - 1).double() * 0.9 * PERIOD
    points = torch.full_like(LIDAR.directions, torch.nan)
    for time in times.unique():
        now = times == time
        T = _interpolated(stamp + float(time)) @ T_BASE_LIDAR
        points[now] = LIDAR.cast(SCENE, T)[now].to(points.dtype)
    base = _interpolated(stamp)
    return Scan(stamp, points.numpy().astype(np.float32), times.numpy(), (base @ T_BASE_LIDAR).numpy(), base.numpy())


def _interpolated(time: float) -> torch.Tensor:
    """The pose between the recorded ones, as a reader finds it."""
    stamps = torch.from_numpy(np.arange(-0.3, SCANS * PERIOD + 0.3, 0.02))
    known = base_at(START + stamps)
    return interpolate_poses(known[None], stamps[None], torch.tensor([[time - START]]).double())[0, 0]


def _look(stamp: float) -> tuple[Scan, np.ndarray]:
    base = _interpolated(stamp)
    T = base @ T_BASE_CAMERA
    points = CAMERA.cast(SCENE, base @ T_BASE_CAMERA @ torch.linalg.inv(_FORWARD))  # x forward
    depth = points.view(CAMERA.height, CAMERA.width, 3)[..., 0].numpy().astype(np.float32)
    return Scan(stamp, points.numpy(), None, T.numpy(), base.numpy()), depth


class Writer:
    """Writes messages to a bag; the names of types are those of ROS 2."""

    def __init__(self, path, kind: str):
        from rosbags.typesys import Stores, get_typestore

        self.kind, self.is1 = kind, kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is1 else Stores.ROS2_HUMBLE)
        if self.is1:
            from rosbags.rosbag1 import Writer as Writer1

            two = get_typestore(Stores.ROS2_HUMBLE)
            self.store.register({"tf2_msgs/msg/TFMessage": two.fielddefs["tf2_msgs/msg/TFMessage"]})
            self.bag: Any = Writer1(path)
        else:
            from rosbags.rosbag2 import StoragePlugin
            from rosbags.rosbag2 import Writer as Writer2

            self.bag = Writer2(path, version=9, storage_plugin=StoragePlugin[kind.upper()])
        self.bag.open()
        if self.is1:
            self.bag.chunk_threshold = 50_000
        self.connections: dict[str, Any] = {}

    def make(self, type_: str, /, **fields: Any) -> Any:
        """Return a message; missing fields are zero."""
        return self.store.types[type_](**fields)

    def header(self, stamp: float, frame: str) -> Any:
        seconds = int(stamp)
        time = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=round((stamp - seconds) * 1e9))
        extra = {"seq": 0} if self.is1 else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **extra)

    def write(self, topic: str, name: str, stamp: float, message: Any) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.bag.add_connection(topic, name, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.is1 else self.store.serialize_cdr
        self.bag.write(self.connections[topic], round(stamp * 1e9), serialize(message, name))

    def pose_parts(self, T, place: str) -> tuple[Any, Any]:
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        point = self.make(f"geometry_msgs/msg/{place}", **dict(zip("xyz", T[:3, 3].tolist(), strict=True)))
        return point, self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def transform(
        self, stamp: float, parent: str, child: str, T, is_static: bool = False, space="", recorded: float | None = None
    ) -> None:
        place, turn = self.pose_parts(T, "Vector3")
        inner = self.make("geometry_msgs/msg/Transform", translation=place, rotation=turn)
        header = self.header(stamp, parent)
        one = self.make("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=inner)
        message = self.make("tf2_msgs/msg/TFMessage", transforms=[one])
        topic, time = f"{space}/tf_static" if is_static else f"{space}/tf", stamp if recorded is None else recorded
        self.write(topic, "tf2_msgs/msg/TFMessage", time, message)

    def odometry(self, stamp: float, T, child="base_link") -> None:
        place, turn = self.pose_parts(T, "Point")
        pose_ = self.make("geometry_msgs/msg/Pose", position=place, orientation=turn)
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        fields = dict(
            header=self.header(stamp, "odom"),
            child_frame_id=child,
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=pose_, covariance=COVARIANCE.ravel()),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )
        self.write(ODOM, "nav_msgs/msg/Odometry", stamp, self.make("nav_msgs/msg/Odometry", **fields))

    def cloud(self, scan: Scan, topic=CLOUD, frame="lidar", recorded: float | None = None, **layout: Any) -> None:
        message = make_cloud(self, scan.points, scan.times, self.header(scan.stamp, frame), **layout)
        self.write(topic, "sensor_msgs/msg/PointCloud2", scan.stamp if recorded is None else recorded, message)
        if self.kind == "mcap":
            self.bag.storage.close_chunk()  # else all is in one, and lost when the file is cut

    def camera_info(self, stamp: float, topic="/camera/depth/camera_info") -> None:
        K = CAMERA.intrinsics.double().numpy().ravel()
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        upper = {"d": np.zeros(5), "k": K, "r": np.eye(3).ravel(), "p": np.zeros(12)}
        fields = {name.upper() if self.is1 else name: value for name, value in upper.items()}
        message = self.make(
            "sensor_msgs/msg/CameraInfo", header=self.header(stamp, "camera"), height=CAMERA.height, width=CAMERA.width,
            distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=roi, **fields,
        )  # fmt: skip
        self.write(topic, "sensor_msgs/msg/CameraInfo", stamp, message)

    def depth(self, stamp: float, depth, encoding="32FC1", topic=DEPTH) -> None:
        if encoding == "32FC1":
            image = np.nan_to_num(depth, nan=0.0).astype("<f4")
        else:
            image = np.round(1e3 * np.nan_to_num(depth, nan=0.0)).astype("<u2")
        header = self.header(stamp, "camera")
        if encoding == "png":
            import cv2

            data = np.frombuffer(bytes(12) + cv2.imencode(".png", image)[1].tobytes(), np.uint8)
            name, fields = "sensor_msgs/msg/CompressedImage", dict(format="16UC1; compressedDepth png", data=data)
        else:
            step = image.shape[1] * image.itemsize
            data = np.frombuffer(image.tobytes(), np.uint8)
            shape = dict(height=image.shape[0], width=image.shape[1], step=step, is_bigendian=0)
            name, fields = "sensor_msgs/msg/Image", dict(encoding=encoding, data=data, **shape)
        self.write(topic, name, stamp, self.make(name, header=header, **fields))

    def close(self) -> None:
        self.bag.close()


def make_cloud(
    writer, points, times, header, dtype="f4", order="xyz", pad=0, bigendian=False, rows=1, time="t", colors=None
) -> Any:
    """A PointCloud2 with fields in this order, `pad` bytes between them and after each row, of `rows` rows.

    `colors` are further fields: name -> (N,) float32, uint32 or uint8.
    """
    end = ">" if bigendian else "<"
    codes = {"f4": 7, "f8": 8, "u4": 6, "u1": 2}
    columns = {name: (dtype, points[:, "xyz".index(name)]) for name in order}
    if times is not None and time == "t":
        columns["t"] = ("u4", np.round((times - times.min()) * 1e9))
    elif times is not None:
        columns["timestamp"] = ("f8", header.stamp.sec + 1e-9 * header.stamp.nanosec + times)
    columns |= {name: (values.dtype.str[1:], values) for name, values in (colors or {}).items()}
    offsets, size = {}, pad
    for name, (code, _) in columns.items():
        offsets[name], size = size, size + int(code[1]) + pad
    width = len(points) // rows
    data = np.zeros((rows, width * size + pad), np.uint8)
    for name, (code, values) in columns.items():
        raw = values.astype(end + code).reshape(rows, width, 1).view(np.uint8)
        for b in range(raw.shape[2]):
            data[:, offsets[name] + b : width * size : size] = raw[:, :, b]
    fields = [
        writer.make("sensor_msgs/msg/PointField", name=name, offset=offsets[name], datatype=codes[code], count=1)
        for name, (code, _) in columns.items()
    ]
    return writer.make(
        "sensor_msgs/msg/PointCloud2", header=header, height=rows, width=width, fields=fields, is_bigendian=bigendian,
        point_step=size, row_step=width * size + pad, data=data.ravel(), is_dense=False,
    )  # fmt: skip


def write_drive(folder, kind="mcap", depth=True, **cloud_layout):
    """Write the drive; return the path of the bag."""
    path, truth = folder / FORMATS[kind], drive()
    writer = Writer(path, kind)
    writer.transform(START - 0.3, "base_link", "lidar", T_BASE_LIDAR.numpy(), is_static=True)
    writer.transform(START - 0.3, "base_link", "camera", T_BASE_CAMERA.numpy(), is_static=True)
    events = [(stamp, "pose", T) for stamp, T in zip(truth.stamps, truth.bases, strict=True)]
    events += [(scan.stamp + 0.001, "cloud", scan) for scan in truth.clouds]
    events += [(scan.stamp + 0.002, "depth", (scan, image)) for scan, image in truth.depths if depth]
    for stamp, what, value in sorted(events, key=lambda event: event[0]):
        if what == "pose":
            writer.transform(stamp, "odom", "base_link", value)
            writer.odometry(stamp, value)
        elif what == "cloud":
            writer.cloud(value, time="timestamp", **cloud_layout)
        else:
            writer.camera_info(value[0].stamp)
            writer.depth(value[0].stamp, value[1])
    writer.close()
    return path
