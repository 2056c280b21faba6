"""A bag of any length: a robot drives in a circle before stairs and boxes; its lidar turns while it moves."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchelev.io.bags.writing import BagWriter
from torchelev.sim import Lidar, cast
from torchelev.sim.exact.scenes import mixed
from torchelev.sim.poses import pose

CLOUDS, POSES, MAP_FRAME, SENSOR_FRAME = "/lidar/points", "/odom", "odom", "lidar"
PERIOD = 0.1  # [s] of a scan
_START = 1_700_000_000.0  # [s] since 1970
_SCANS = 20  # after which the circle is closed, and scans repeat
_PARTS = 16  # of a scan, each from its own pose
_POSES = 5  # per scan
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])


def sensor_at(time: float) -> Tensor:
    """Return the pose of the lidar at a time [s] since the start: a circle of 0.5 m, 0.8 m above the ground."""
    angle = 2 * math.pi * time / (_SCANS * PERIOD)
    place = torch.tensor([0.5 * math.cos(angle), 0.5 * math.sin(angle), 0.8], dtype=torch.float64)
    return pose(place, angle + math.pi / 2)


@cache
def spin(index: int, lidar: Lidar) -> NDArray:
    """Return the points of a scan, which ends one period after its stamp, with their times [ns]."""
    order = torch.arange(len(lidar.directions)) % lidar.azimuths  # rings one after the other
    part = order * _PARTS // lidar.azimuths
    cloud, scene = np.zeros(len(order), _POINT), mixed()
    cloud["t"] = np.round(1e9 * PERIOD * 0.999 * part.numpy() / (_PARTS - 1))
    for k in range(_PARTS):
        now = part == k
        T, directions = sensor_at(PERIOD * (index + 0.999 * k / (_PARTS - 1))), lidar.directions[now]
        points = directions * cast(scene, T[:3, 3], directions @ T[:3, :3].T, lidar.max_range)[:, None]
        for axis, values in zip("xyz", points.T.numpy(), strict=True):
            cloud[axis][now.numpy()] = values
    return cloud


def write_bag(path: Path, num_scans: int, lidar: Lidar) -> None:
    """Write the scans and five times as many poses; the path's suffix is the format."""
    with BagWriter(path) as bag:
        for k in range(num_scans):
            for part in range(_POSES + (k == num_scans - 1)):
                _write_pose(bag, PERIOD * (k + part / _POSES))
            _write_cloud(bag, PERIOD * k, spin(k % _SCANS, lidar))


def _write_pose(bag: BagWriter, time: float) -> None:
    T = sensor_at(time)
    angle = float(torch.atan2(T[1, 0], T[0, 0])) / 2
    x, y, z = T[:3, 3].tolist()
    point = bag.make("geometry_msgs/msg/Point", x=x, y=y, z=z)
    turn = bag.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(angle), w=math.cos(angle))
    zero = bag.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    where, unknown = bag.make("geometry_msgs/msg/Pose", position=point, orientation=turn), np.zeros(36)
    twist = bag.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    _write(
        bag, POSES, "nav_msgs/msg/Odometry", time, MAP_FRAME, child_frame_id=SENSOR_FRAME,
        pose=bag.make("geometry_msgs/msg/PoseWithCovariance", pose=where, covariance=unknown),
        twist=bag.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown),
    )  # fmt: skip


def _write_cloud(bag: BagWriter, time: float, cloud: NDArray) -> None:
    kinds = {"x": 7, "y": 7, "z": 7, "t": 6}  # FLOAT32 and UINT32 of sensor_msgs/PointField
    fields = [
        bag.make("sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=kind, count=1)
        for k, (name, kind) in enumerate(kinds.items())
    ]
    _write(
        bag, CLOUDS, "sensor_msgs/msg/PointCloud2", time, SENSOR_FRAME, height=1, width=len(cloud), fields=fields,
        is_bigendian=False, point_step=_POINT.itemsize, row_step=cloud.nbytes, data=cloud.view(np.uint8),
        is_dense=False,
    )  # fmt: skip


def _write(bag: BagWriter, topic: str, type_: str, time: float, frame: str, **fields: Any) -> None:
    stamp = _START + time
    bag.write(topic, type_, stamp, bag.make(type_, header=bag.make_header(stamp, frame), **fields))
