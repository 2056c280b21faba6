"""A bag as a recording: its scans with poses, one after the other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.frames import deskew
from torchelev.io.bags.bag import Bag, Message, Topic
from torchelev.io.bags.covariance import PoseCovariances
from torchelev.io.bags.order import order_by_stamp
from torchelev.io.bags.point_cloud import CloudError
from torchelev.io.bags.scans import CLOUDS, IMAGES, Scan, read_scan
from torchelev.io.bags.transforms import FrameError, TransformTree
from torchelev.io.errors import RecordingError
from torchelev.io.folders.recording import Frame

ODOMETRY, POSE, CAMERA = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/CameraInfo"
TRANSFORMS = {"/tf": False, "/tf_static": True}  # topic -> whether its transforms are static
_PERIODS = 0.02, 1.0  # [s] shortest and longest period of scans that is believed
_MAX_GAP = 1.0  # [s] between two poses without a warning
_POSE_STEP, _MAX_POSES = 0.01, 64  # [s] between the poses of a scan, and how many there are at most
_LATE = "some scans are older than those before them, and are fused with dt = 0"
_BASES = ("base_link", "base_footprint", "base", "trunk", "body")


class BagRequest(NamedTuple):
    """What to read from a bag; None and () are found in the bag."""

    clouds: Sequence[str] = ()  #: topics of clouds or laser scans
    depths: Sequence[str] = ()  #: topics of depth images
    map_frame: str | None = None  #: in which the map is built
    base_frame: str | None = None  #: which the window follows
    poses: str | None = None  #: topic of Odometry or PoseStamped in place of the transforms


class BagRecording:
    """The scans of a bag in the order of their stamps. Iterating reads it once more from the start.

    Attributes:
        map_frame: in which the poses are.
        base_frame: whose pose a frame's `T_map_base` is.
        has_base: whether that is another frame than the sensor's, so that the sensor's place on the robot is known.
        topics: of the scans.
        pose_notes: frames with several parents, and gaps in the poses.
        skipped: number of scans that were left out when it was last read, by reason.
        notes: what is not used of the scans' messages.
    """

    def __init__(self, bag: Bag, request: BagRequest, show: Any = iter) -> None:
        self._bag, types = bag, {topic.name: topic for topic in bag.topics}
        self.topics = _choose_topics(bag, types, request)
        self._num = sum(types[name].num for name in self.topics)
        period = bag.duration / max(1, max(types[name].num for name in self.topics) - 1)
        self.tree = TransformTree(float(np.clip(period, *_PERIODS)))
        self._covariances = PoseCovariances()
        self._cameras = _find_cameras(bag, types, request.depths)
        self._read_poses(request, types, show)
        sensor = self._first_frame()
        self.map_frame, self.base_frame = _choose_frames(bag, self.tree, sensor, request)
        self.has_base = self.base_frame != sensor
        gaps = [self.tree.describe_gaps(self.map_frame, frame, _MAX_GAP) for frame in (self.base_frame, sensor)]
        self.pose_notes = [*self.tree.describe_conflicts(), *dict.fromkeys(line for lines in gaps for line in lines)]
        self.skipped: Counter[str] = Counter()
        self.notes: dict[str, None] = {}

    def __len__(self) -> int:
        return self._num

    @property
    def ended_early(self) -> str:
        """Where and why the bag could not be read on; "" if it could."""
        return self._bag.ended_early

    @property
    def warnings(self) -> list[str]:
        """What was left out when the scans were last read, what is wrong with the poses, and where the bag ended."""
        skipped = [f"{number} of {self._num} scans were left out: {reason}" for reason, number in self.skipped.items()]
        return [*skipped, *self.pose_notes, *self.notes, *([self.ended_early] if self.ended_early else [])]

    @property
    def middle(self) -> NDArray[np.float64]:
        """The middle (3,) [m] of the base's path, map frame."""
        stamps = self.tree.stamps(self.map_frame, self.base_frame)
        places = self.tree.look_up(self.map_frame, self.base_frame, stamps)[:, :3, 3]
        return (np.nanmin(places, 0) + np.nanmax(places, 0)) / 2

    def __iter__(self) -> Iterator[Frame | None]:
        """Yield a frame for each message of a sensor: None where it has to be left out, see `skipped`."""
        self.skipped.clear()
        self.notes.clear()
        last: float | None = None
        for message in order_by_stamp(self._bag.read(self.topics), self.topics):
            try:
                frame = self._to_frame(message, last)
            except CloudError as error:
                self.skipped[str(error)] += 1
                frame = None
            except FrameError as error:
                raise RecordingError(self._bag.path, str(error), "give --map-frame and --base-frame") from error
            if frame is not None:
                last = frame.stamp if last is None else max(last, frame.stamp)
            yield frame

    def _to_frame(self, message: Message, last: float | None) -> Frame | None:
        """Return a message's scan at its stamp; None, and counted, if it has no pose."""
        scan = read_scan(message.data, self._cameras.get(message.topic))
        if scan.note:
            self.notes[f"{message.topic}: {scan.note}"] = None
        now = np.array([scan.stamp])
        T_map_sensor = self.tree.look_up(self.map_frame, scan.frame, now)[0]
        T_map_base = self.tree.look_up(self.map_frame, self.base_frame, now)[0]
        if not (np.isfinite(T_map_sensor).all() and np.isfinite(T_map_base).all()):
            self.skipped[f"no pose of {scan.frame} in {self.map_frame} at that time"] += 1
            return None
        covariance = self._covariances.of_sensor(scan.stamp, T_map_sensor[:3, 3] - T_map_base[:3, 3])
        dt = 0.0 if last is None else scan.stamp - last
        if dt < 0:
            self.notes[f"{message.topic}: {_LATE}"] = None
        points = self._still(scan)
        return Frame(points, T_map_sensor, max(0.0, dt), message.topic, T_map_base, covariance, scan.stamp)

    def _still(self, scan: Scan) -> NDArray[np.float32]:
        """Return the points as seen from the sensor's place at the stamp."""
        if scan.times is None:
            return scan.points
        finite = scan.times[np.isfinite(scan.times)]
        first, last = min(float(finite.min()), 0.0), max(float(finite.max()), 0.0)
        num = int(np.clip(np.ceil((last - first) / _POSE_STEP) + 1, 2, _MAX_POSES))
        times = np.linspace(first, last, num)
        poses = self.tree.look_up(self.map_frame, scan.frame, scan.stamp + times)
        known = np.isfinite(poses).all((1, 2))
        if known.sum() < 2:
            self.notes[f"{scan.frame}: too few poses within a scan to take its motion out"] = None
            return scan.points
        given = scan.points, scan.times, poses[known], times[known]
        points, at, T, stamps = (torch.from_numpy(np.ascontiguousarray(value))[None] for value in given)
        return deskew(points, at, T, stamps, torch.zeros(1), self.tree.max_extrapolation)[0].numpy()

    def _first_frame(self) -> str:
        """Return the frame of the first scan."""
        for message in self._bag.read(self.topics):
            return message.data.header.frame_id.lstrip("/")
        reason = self._bag.ended_early or f"no messages on {', '.join(self.topics)}"
        raise RecordingError(self._bag.path, reason, "choose another topic with --points or --depth")

    def _read_poses(self, request: BagRequest, types: dict[str, Topic], show: Any) -> None:
        """Read all transforms, and the poses of the requested topic."""
        topics = [*TRANSFORMS, *([request.poses] if request.poses else [])]
        self._check_poses(request, types)
        for message in show(self._bag.read(topics)):
            if message.topic in TRANSFORMS:
                self.tree.add_message(message.data, TRANSFORMS[message.topic])
            elif types[message.topic].type == ODOMETRY:
                self.tree.add_odometry(message.data)
                self._covariances.add(message.data)
            else:
                self.tree.add_pose(message.data, str(request.base_frame))

    def _check_poses(self, request: BagRequest, types: dict[str, Topic]) -> None:
        """Refuse a topic of poses that is not there, is of another type or leaves the frame open."""
        if request.poses is None:
            return
        kind = types[request.poses].type if request.poses in types else "not in the bag"
        if kind not in (ODOMETRY, POSE):
            have = _name([t for t in types.values() if t.type in (ODOMETRY, POSE)])
            raise RecordingError(self._bag.path, f"--poses {request.poses} is {kind}", f"topics of poses are {have}")
        if kind == POSE and request.base_frame is None:
            raise RecordingError(self._bag.path, f"{request.poses} does not say whose pose it is", "give --base-frame")


def open_bag(bag: Bag, request: BagRequest | None = None, show: Any = iter) -> BagRecording:
    """Read the transforms of a bag, and find its sensors and frames.

    Args:
        bag: an open bag.
        request: what to read; None: find all in the bag.
        show: wraps the iteration over the messages of transforms, for a progress bar.

    Returns:
        The recording. Scans are read when it is iterated.

    Raises:
        RecordingError: a topic or frame is missing, or several could be meant; the message names them.
    """
    return BagRecording(bag, request or BagRequest(), show)


def _choose_topics(bag: Bag, types: dict[str, Topic], request: BagRequest) -> list[str]:
    """Return the requested topics, or the only one of clouds."""
    for names, kinds, option in ((request.clouds, CLOUDS, "--points"), (request.depths, IMAGES, "--depth")):
        for name in names:
            kind = types[name].type if name in types else "not in the bag"
            if kind not in kinds:
                have = _name([topic for topic in types.values() if topic.type in kinds])
                raise RecordingError(bag.path, f"{option} {name} is {kind}", f"such topics are {have}")
    chosen = [*request.clouds, *request.depths]
    if chosen:
        return chosen
    for kind in CLOUDS:
        found = [topic for topic in types.values() if topic.type == kind]
        if len(found) == 1:
            return [found[0].name]
        if found:
            raise RecordingError(bag.path, f"there are {len(found)} topics of clouds: {_name(found)}", "give --points")
    have = _name(list(types.values()))
    raise RecordingError(bag.path, f"there is no topic of clouds; topics are {have}", "give --depth for depth images")


def _name(topics: list[Topic]) -> str:
    return ", ".join(topic.name for topic in topics) or "none"


def _find_cameras(bag: Bag, types: dict[str, Topic], depths: Sequence[str]) -> dict[str, Any]:
    """Return the CameraInfo of each topic of depth images: the one beside it."""
    cameras = {}
    for depth in depths:
        # compressedDepth adds a level: /camera/depth/image_rect_raw/compressedDepth
        folders = [depth.rsplit("/", level)[0] for level in (1, 2)]
        info = next((f"{folder}/camera_info" for folder in folders if f"{folder}/camera_info" in types), None)
        if info is None:
            have = _name([topic for topic in types.values() if topic.type == CAMERA])
            raise RecordingError(bag.path, f"{depth} has no camera_info beside it", f"topics of CameraInfo are {have}")
        message = next(bag.read([info]), None)
        if message is None:
            raise RecordingError(bag.path, f"{info} holds no message", "record it with the images")
        cameras[depth] = message.data
    return cameras


def _choose_frames(bag: Bag, tree: TransformTree, sensor: str, request: BagRequest) -> tuple[str, str]:
    """Return the map's and the base's frame: the requested ones, or those between which the robot moves."""
    given = [frame for frame in (request.map_frame, request.base_frame, sensor) if frame is not None]
    missing = next((frame for frame in given if frame not in tree.frames), None)
    if missing is not None:
        have = ", ".join(tree.frames) or "none"
        hint = "choose one of them" if tree.frames else "give --poses TOPIC if the bag holds Odometry"
        raise RecordingError(bag.path, f"the transforms have no frame {missing}; frames are {have}", hint)
    chain = tree.ancestors(sensor)
    moving = [frame for frame in chain[:-1] if not tree.is_static(frame)]
    if request.base_frame is None and not moving:
        raise RecordingError(bag.path, f"no transform moves {sensor}; above it are {', '.join(chain[1:]) or 'none'}",
                             "give --poses TOPIC, or --map-frame and --base-frame of a still robot")  # fmt: skip
    named = [frame for frame in moving if frame.rsplit("/", 1)[-1] in _BASES]
    base = request.base_frame or (named or moving)[0]
    above = tree.ancestors(base)
    if request.map_frame is None and len(above) < 2:
        raise RecordingError(bag.path, f"there is no frame above {base}", "give --map-frame")
    return request.map_frame or _moving_parent(tree, above), base


def _moving_parent(tree: TransformTree, above: list[str]) -> str:
    """Return the first frame in which the base moves: above it, odometry comes before localisation."""
    for child, parent in zip(above, above[1:], strict=False):
        if not tree.is_static(child):
            return parent
    return above[-1]
