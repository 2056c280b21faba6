"""A bag as a recording: its scans with poses, one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.bag import Bag, Message
from torchelev.io.bags.cameras import doubt_axes, find_cameras
from torchelev.io.bags.colors import require_colors
from torchelev.io.bags.labels import LabelTopic, attach_images
from torchelev.io.bags.order import order_by_stamp
from torchelev.io.bags.periods import find_period
from torchelev.io.bags.point_cloud import CloudError
from torchelev.io.bags.poses.clocks import SettingWatch
from torchelev.io.bags.poses.missing import require_frames, require_way
from torchelev.io.bags.poses.placing import Placed, place_poses
from torchelev.io.bags.poses.reading import time_of
from torchelev.io.bags.poses.transforms import FrameError
from torchelev.io.bags.poses.within_scan import hold_still
from torchelev.io.bags.scans import Scan, clean, read_scan
from torchelev.io.bags.topics import BagRequest, choose_topics, find_depth
from torchelev.io.errors import RecordingError
from torchelev.io.folders.recording import Frame
from torchelev.io.labels import LabelImage
from torchelev.io.notes import Reasons

_MAX_GAP = 1.0  # [s] between two poses without a warning
_OTHER_CLOCK = "these stamps are not those of the poses; give --stamps recorded"
_LATE = "some scans are older than those before them, and are fused with dt = 0"


class BagRecording:
    """The scans of a bag in the order of their stamps. Iterating reads it once more from the start.

    Attributes:
        map_frame: in which the poses are.
        base_frame: whose pose a frame's `T_map_base` is.
        rays_from: the frame at which the rays start of clouds that are in the map's frame already; "" for other clouds.
        has_base: whether the base is another frame than the sensor's, so that the sensor's place on the robot is known.
        topics: of the scans.
        labels: topic of images of class labels; None: none was asked for.
        skipped: number of scans that were left out when it was last read, by reason.
        notes: what is not used of the scans' messages.
    """

    def __init__(self, bag: Bag, request: BagRequest, show: Any = iter) -> None:
        self._bag, types = bag, {topic.name: topic for topic in bag.topics}
        request = find_depth(types, request)
        self.topics = choose_topics(bag, types, request)
        self._num = sum(types[name].num for name in self.topics)
        self._cameras = find_cameras(bag, types, request)
        if request.colors:
            require_colors(bag, [name for name in self.topics if name not in self._cameras])
        self.labels = None if request.semantic is None else LabelTopic(bag, types, request, show)
        self._periods = {name: find_period(bag, name) for name in self.topics if name not in self._cameras}
        self._placed: Placed = place_poses(bag, request, self.topics, _MAX_GAP, show)
        self._request, self.tree = request, self._placed.tree
        self.map_frame, self.base_frame, self.rays_from = self._placed.map, self._placed.base, self._placed.rays_from
        self.has_base = self.base_frame != self._placed.sensor
        if self.labels is not None:
            require_frames(bag, request, self.tree, [self.labels.frame])
            require_way(bag.path, self.tree, self.map_frame, self.labels.frame)
        self.skipped, self.notes, self._watch = Reasons(), Reasons(), SettingWatch(self._placed.clock)

    def __len__(self) -> int:
        return self._num

    @property
    def pose_notes(self) -> list[str]:
        """Notes on doubtful poses: frames, clocks, gaps, jumps. Known before the scans are read."""
        return self._placed.notes

    @property
    def clock_offsets(self) -> dict[str, float]:
        """Offsets [s] that the stamps of topics need, by their clocks."""
        return self._placed.offsets

    @property
    def ended_early(self) -> str:
        """Where and why reading stopped before the end of the bag; "" if it did not."""
        return self._bag.ended_early

    @property
    def warnings(self) -> list[str]:
        """Notes on scans that were left out in the last reading, on faulty poses, and on where the bag ended."""
        skipped = [f"{number} of {self._num} scans were left out: {reason}" for reason, number in self.skipped.items()]
        return [
            *skipped,
            *self.pose_notes,
            *self._watch.notes,
            *self.notes,
            *([self.ended_early] if self.ended_early else []),
        ]

    @property
    def middle(self) -> NDArray[np.float64]:
        """The middle (3,) [m] of the base's path, map frame."""
        stamps = self.tree.stamps(self.map_frame, self.base_frame)
        places = self.tree.look_up(self.map_frame, self.base_frame, stamps)[:, :3, 3]
        return (np.nanmin(places, 0) + np.nanmax(places, 0)) / 2

    def odometry_poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64], str]:
        """Return stamps (K,) [s], poses (K, 4, 4) and the frame of the lidar that `BagRequest.odometry` followed."""
        stamps, sensor = self._placed.odometry_stamps, self._placed.sensor
        stamps = np.zeros(0) if stamps is None else stamps
        return stamps, self.tree.look_up(self.map_frame, sensor, stamps), sensor

    def __iter__(self) -> Iterator[Frame | None]:
        """Yield a frame for each message of a sensor: None where it has to be left out, see `skipped`."""
        return attach_images(self._read())

    def _read(self) -> Iterator[Frame | LabelImage | None]:
        """Yield scans and images of labels in the order of their stamps; None for a scan that has to be left out."""
        self.skipped.clear()
        self.notes.clear()
        self._watch = SettingWatch(self._placed.clock)
        last: float | None = None
        for message in order_by_stamp(self._messages(), self._all_topics, self._time_of):
            if self.labels is not None and message.topic == self.labels.name:
                yield from self._to_labels(self.labels, message)
                continue
            try:
                frame = self._to_frame(message, last)
            except CloudError as error:
                self.skipped.count(str(error), error.kind)
                frame = None
            except FrameError as error:
                raise RecordingError(self._bag.path, str(error), "give --map-frame and --base-frame") from error
            if frame is not None:
                last = frame.stamp if last is None else max(last, frame.stamp)
            yield frame

    def _messages(self) -> Iterator[Message]:
        """Read the scans that were recorded in the time that is mapped."""
        start, end = self._placed.span
        return (message for message in self._bag.read(self._all_topics) if start <= message.time <= end)

    @property
    def _all_topics(self) -> list[str]:
        return [*self.topics, *([] if self.labels is None else [self.labels.name])]

    def _to_labels(self, labels: LabelTopic, message: Message) -> list[LabelImage]:
        """Return an image of labels; [], and noted, if it cannot be used."""
        frame, now = clean(message.data.header.frame_id), np.array([self._time_of(message)])
        try:
            T_map_camera = self.tree.look_up(self.map_frame, frame, now)[0]
            image, notes = labels.read(message.data, T_map_camera)
        except (CloudError, FrameError) as error:
            self.notes.count(f"{message.topic}: {error}", f"{message.topic}: {getattr(error, 'kind', '')}")
            return []
        if not np.isfinite(T_map_camera).all():
            notes = [f"no pose of {frame} in {self.map_frame} at the time of some images, which are left out"]
        for note in notes:
            self.notes.count(f"{message.topic}: {note}")
        return [image] if np.isfinite(T_map_camera).all() else []

    def _time_of(self, message: Message) -> float:
        """Return the time [s] of a scan by the clock of the poses."""
        offsets = self._request.clock_offsets
        return time_of(message, self._request) + offsets.get(message.topic, offsets.get("", 0.0))

    def _to_frame(self, message: Message, last: float | None) -> Frame | None:
        """Return a message's scan at its stamp; None, and counted, if it has no pose or is not asked for."""
        camera, period = self._cameras.get(message.topic), self._periods.get(message.topic)
        scan = read_scan(message.data, camera, period, self._request.colors)._replace(stamp=self._time_of(message))
        for note in scan.notes:
            self.notes.count(f"{message.topic}: {note.text}", f"{message.topic}: {note.kind}")
        known = message.topic in self.clock_offsets
        if not known and self._watch.is_set(message.topic, scan.stamp, message.time):
            self.skipped.count(f"the clock of {message.topic} was set during the recording: {_OTHER_CLOCK}")
            return None
        frame = self.rays_from if scan.frame in self._placed.fixed else scan.frame
        now = np.array([scan.stamp])
        T_map_sensor = self.tree.look_up(self.map_frame, frame, now)[0]
        T_map_base = self.tree.look_up(self.map_frame, self.base_frame, now)[0]
        if not (np.isfinite(T_map_sensor).all() and np.isfinite(T_map_base).all()):
            self.skipped.count(f"no pose of {frame} in {self.map_frame} at that time")
            return None
        if doubt := doubt_axes(camera, scan.frame, T_map_sensor):
            self.notes.count(f"{message.topic}: {doubt}")
        covariance = self._placed.covariances.of_sensor(scan.stamp, T_map_sensor[:3, 3] - T_map_base[:3, 3])
        dt = 0.0 if last is None else scan.stamp - last
        if dt < 0:
            self.notes.count(f"{message.topic}: {_LATE}")
        points = self._see(scan)
        frame_dt = max(0.0, dt)
        return Frame(points, T_map_sensor, frame_dt, message.topic, T_map_base, covariance, scan.stamp, scan.colors)

    def _see(self, scan: Scan) -> NDArray[np.float32]:
        """Return the points as seen at the stamp, in the sensor's frame or in that where the rays start."""
        if scan.frame in self._placed.fixed:
            T = self.tree.look_up(self.rays_from, scan.frame, np.array([scan.stamp]))[0]
            return (scan.points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
        points = hold_still(self.tree, self.map_frame, scan)
        if points is None:
            self.notes.count(f"{scan.frame}: too few poses within a scan to take its motion out")
        return scan.points if points is None else points


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
