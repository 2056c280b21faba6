"""Write a simulated drive as a bag: clouds, IMU and the lidar's mounting, with true poses or without."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.quality.odometry.drive import T_BASE_LIDAR, Drive, RollingScan
from torchelev.io.bags.poses.rows import from_matrix
from torchelev.io.bags.writing import BagWriter

CLOUDS, IMU, START = "/lidar/points", "/imu/data", 1_700_000_000.0  # [s] since 1970
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])


def write_drive(path: Path, drive: Drive, num_scans: int, poses: bool = False, base: str = "base_link") -> None:
    """Write the first scans of a drive; its stamps count from `START`.

    Args:
        path: of the bag; its suffix is the format.
        drive: the drive.
        num_scans: number of scans.
        poses: whether it holds the true poses of the base in odom, 50 a second.
        base: frame of the base above the lidar; "": nothing says where the lidar is.
    """
    scans = [drive.scan(k) for k in range(num_scans)]
    end = scans[-1].stamp + 0.2
    with BagWriter(path) as bag:
        events: list[tuple[float, Any, Any]] = [(scan.stamp + 0.1, _write_cloud, scan) for scan in scans]
        times, forces = drive.accelerations()
        keep = [k for k in range(0, len(times), 2) if times[k] <= end]
        events += [(float(times[k]), _write_imu, (float(times[k]), forces[k])) for k in keep]
        if poses:
            known = [k for k in range(0, len(drive.times), 4) if float(drive.times[k]) <= end]
            rows = [("odom", base, float(drive.times[k]), drive.bases[k].numpy()) for k in known]
            events += [(row[2], _write_transform, row) for row in rows]
        if base:
            _write_transform(bag, 0.0, (base, "lidar", 0.0, T_BASE_LIDAR.numpy()), "/tf_static")
            _write_transform(bag, 0.0, (base, "imu", 0.0, np.eye(4)), "/tf_static")
        for time, write, value in sorted(events, key=lambda event: event[0]):
            write(bag, time, value)


def _write(bag: BagWriter, topic: str, type_: str, recorded: float, header: tuple[float, str], **fields: Any) -> None:
    stamped = bag.make_header(START + header[0], header[1])
    bag.write(topic, type_, START + recorded, bag.make(type_, header=stamped, **fields))


def _write_cloud(bag: BagWriter, recorded: float, scan: RollingScan) -> None:
    cloud = np.zeros(len(scan.points), _POINT)
    for axis, values in zip("xyz", scan.points.T, strict=True):
        cloud[axis] = values
    cloud["t"] = np.round(1e9 * scan.times)
    kinds: Iterable[tuple[str, int]] = (("x", 7), ("y", 7), ("z", 7), ("t", 6))  # FLOAT32 and UINT32
    fields = [
        bag.make("sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=kind, count=1)
        for k, (name, kind) in enumerate(kinds)
    ]
    _write(
        bag, CLOUDS, "sensor_msgs/msg/PointCloud2", recorded, (scan.stamp, "lidar"), height=1, width=len(cloud),
        fields=fields, is_bigendian=False, point_step=_POINT.itemsize, row_step=cloud.nbytes,
        data=cloud.view(np.uint8), is_dense=False,
    )  # fmt: skip


def _write_imu(bag: BagWriter, recorded: float, value: tuple[float, NDArray[np.float64]]) -> None:
    x, y, z = value[1].tolist()
    zero = bag.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    none = np.zeros(9)
    _write(
        bag, IMU, "sensor_msgs/msg/Imu", recorded, (value[0], "imu"), orientation_covariance=-np.eye(3).ravel(),
        orientation=bag.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        angular_velocity=zero, angular_velocity_covariance=none, linear_acceleration_covariance=none,
        linear_acceleration=bag.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
    )  # fmt: skip


def _write_transform(
    bag: BagWriter, recorded: float, row: tuple[str, str, float, NDArray[np.float64]], topic: str = "/tf"
) -> None:
    parent, child, stamp, T = row
    x, y, z, qx, qy, qz, qw = from_matrix(T)
    place = bag.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
    turn = bag.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw)
    one = bag.make(
        "geometry_msgs/msg/TransformStamped", header=bag.make_header(START + stamp, parent), child_frame_id=child,
        transform=bag.make("geometry_msgs/msg/Transform", translation=place, rotation=turn),
    )  # fmt: skip
    bag.write(topic, "tf2_msgs/msg/TFMessage", START + recorded, bag.make("tf2_msgs/msg/TFMessage", transforms=[one]))
