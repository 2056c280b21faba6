"""Poses of a bag that has none, from its clouds: the motion of the base in a frame whose z axis points up."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.bag import Bag, Message
from torchelev.io.bags.order import order_by_stamp
from torchelev.io.bags.periods import find_period
from torchelev.io.bags.point_cloud import CloudError
from torchelev.io.bags.poses.names import is_base, is_world
from torchelev.io.bags.poses.reading import time_of
from torchelev.io.bags.poses.rows import from_matrix, invert
from torchelev.io.bags.poses.transforms import FrameError, TransformTree
from torchelev.io.bags.scans import LIDARS, clean, read_scan
from torchelev.io.bags.topics import BagRequest, name_topics
from torchelev.io.errors import RecordingError
from torchelev.io.odometry import OdometryError, Sweep, Track, align, estimate_track, up_from_ground, up_from_imu

_IMU = "sensor_msgs/msg/Imu"
_MAP = "odom"  # name of the map's frame if none is asked for
_NO_GROUND = "no ground was found around the first scans: the map's z axis is that of {}; give --imu TOPIC"


def add_lidar_odometry(
    bag: Bag, request: BagRequest, topics: Sequence[str], span: tuple[float, float], tree: TransformTree, show: Any
) -> tuple[NDArray[np.float64], list[str]]:
    """Add the poses of the base by odometry of the first topic's clouds, in place of all above it in the tree.

    The base is the robot's frame at the top of what is fixed to the lidar. The map's origin is its first pose, the x
    axis its heading there, and z points up: against gravity with an IMU, else along the normal of the ground.

    Returns:
        Stamps (K,) [s] of the scans with poses, and what is doubtful.

    Raises:
        RecordingError: the topic holds no clouds, or the odometry is lost.
    """
    topic = topics[0]
    _require_clouds(bag, request, topic)
    reader = _Reader(bag, request, topic, span)
    try:
        track = estimate_track(show(reader))
        base, T_base_sensor = _find_base(tree, reader.frame, request)
        notes = [f"{number} scans have no odometry: {reason}" for reason, number in track.skipped.items()]
        mount = T_base_sensor if request.T_base_sensor is None else request.T_base_sensor
        up = _find_up(bag, request, span, tree, track, reader.frame, mount[2, :3])
    except OdometryError as error:
        raise RecordingError(bag.path, f"--odometry {request.odometry}: {error}") from error
    if up is None:
        notes.append(_NO_GROUND.format(base))
    first, T_map_start = invert(mount), np.eye(4)
    T_map_start[:3, :3] = align(mount[2, :3] if up is None else up, first[:3, 0])
    T_map_start[:3, 3] = -T_map_start[:3, :3] @ first[:3, 3]
    bases = T_map_start @ track.T_start_sensor @ invert(T_base_sensor)
    tree.replace(base)
    name = clean(request.map_frame or _MAP)
    tree.replace(name)
    for time, T in zip(track.times, bases, strict=True):
        tree.add(name, base, time, from_matrix(T), recorded=time + reader.delay)
    return track.stamps, notes


class _Reader:
    """The clouds of a topic, in the order of their stamps."""

    def __init__(self, bag: Bag, request: BagRequest, topic: str, span: tuple[float, float]) -> None:
        self._bag, self._request, self._topic, self._span = bag, request, topic, span
        self.frame = ""
        self.delay = 0.0  # [s] of the first message's recording after its stamp
        self._num = next(one.num for one in bag.topics if one.name == topic)
        self._period = find_period(bag, topic)

    def __len__(self) -> int:
        return self._num

    def __iter__(self) -> Iterator[Sweep]:
        offsets = self._request.clock_offsets
        offset = offsets.get(self._topic, offsets.get("", 0.0))

        def stamp(message: Message) -> float:
            return time_of(message, self._request) + offset

        messages = (one for one in self._bag.read([self._topic]) if self._span[0] <= one.time <= self._span[1])
        for message in order_by_stamp(messages, [self._topic], stamp):
            try:
                scan = read_scan(message.data, period=self._period)
            except CloudError:  # counted when the scans are mapped
                continue
            if not self.frame:
                self.frame, self.delay = scan.frame, message.time - stamp(message)
            yield Sweep(stamp(message), scan.points, scan.times)


def _require_clouds(bag: Bag, request: BagRequest, topic: str) -> None:
    kind = next(one.type for one in bag.topics if one.name == topic)
    if kind not in LIDARS:
        have = name_topics([one for one in bag.topics if one.type in LIDARS])
        reason = f"--odometry {request.odometry}: {topic} is {kind}, and odometry needs a 3-D lidar"
        raise RecordingError(bag.path, reason, f"topics of clouds are {have}; give the lidar's first, --points")
    if request.poses or request.rays_from:
        option = "--poses" if request.poses else "--rays-from"
        raise RecordingError(bag.path, f"--odometry and {option} contradict each other", "give one of them")


def _find_base(tree: TransformTree, sensor: str, request: BagRequest) -> tuple[str, NDArray[np.float64]]:
    """Return the frame of the base and the lidar's pose (4, 4) there: what is fixed to the lidar, up to a base."""
    if request.T_base_sensor is not None:
        return sensor, np.eye(4)  # the base is put below the sensor later
    chain = tree.ancestors(sensor)
    rigid = [sensor]
    for child, parent in zip(chain, chain[1:], strict=False):
        if not tree.is_constant(child) or is_world(parent):
            break
        rigid.append(parent)
    named = [frame for frame in rigid if is_base(frame)]
    base = clean(request.base_frame or "") or (named or rigid[-1:])[0]
    if base not in rigid:
        raise OdometryError(f"{base} is not fixed to the lidar's frame {sensor}; fixed are {', '.join(rigid)}")
    return base, tree.look_up(base, sensor, np.array([_any_time(tree, rigid)]))[0]


def _any_time(tree: TransformTree, rigid: list[str]) -> float:
    """Return a time at which the poses between frames that never move are known."""
    stamps = [tree.recorded_rows(frame)[0, 0] for frame in rigid[:-1] if not tree.is_static(frame)]
    return max(stamps, default=0.0)


def _find_up(
    bag: Bag, request: BagRequest, span: tuple[float, float], tree: TransformTree, track: Track, sensor: str,
    prior: NDArray[np.float64],
) -> NDArray[np.float64] | None:  # fmt: skip
    """Return which way is up (3,) in the frame of the first pose; None: there is no IMU and no ground."""
    ground = up_from_ground(track.nearby, prior)
    if request.imu is None:
        return ground
    times, forces, frame = _read_imu(bag, request, span)
    try:
        R = np.eye(3) if frame == sensor else tree.look_up(sensor, frame, track.times[:1])[0, :3, :3]
    except FrameError as error:
        raise OdometryError(f"--imu {request.imu}: {error}") from error
    up = up_from_imu(track, times, forces, R)
    if ground is not None and up @ ground < 0.7:
        angle = np.degrees(np.arccos(np.clip(up @ ground, -1, 1)))
        raise OdometryError(f"--imu {request.imu}: up is {angle:.0f} degrees off the normal of the ground; check the "
                            f"transform between {sensor} and {frame}, and the IMU's axes")  # fmt: skip
    return up


def _read_imu(
    bag: Bag, request: BagRequest, span: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64], str]:
    """Return the times (M,) [s], the forces (M, 3) and the frame of the IMU."""
    kind = next((one.type for one in bag.topics if one.name == request.imu), "not in the bag")
    if kind != _IMU:
        have = name_topics([one for one in bag.topics if one.type == _IMU])
        raise RecordingError(bag.path, f"--imu {request.imu} is {kind}", f"topics of Imu are {have}")
    times, forces, frame = [], [], ""
    for message in bag.read([str(request.imu)]):
        if span[0] <= message.time <= span[1]:
            frame = frame or clean(message.data.header.frame_id)
            times.append(time_of(message, request))
            forces.append([getattr(message.data.linear_acceleration, axis) for axis in "xyz"])
    return np.array(times), np.array(forces).reshape(-1, 3), frame
