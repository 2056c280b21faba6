"""A bag as a recording: its scans with poses, one after the other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.bag import Bag, Message
from torchelev.io.bags.order import order_by_stamp
from torchelev.io.bags.point_cloud import CloudError
from torchelev.io.bags.poses.frames import choose_frames
from torchelev.io.bags.poses.reading import read_poses
from torchelev.io.bags.poses.within_scan import hold_still
from torchelev.io.bags.scans import read_scan
from torchelev.io.bags.topics import BagRequest, choose_topics, find_cameras
from torchelev.io.bags.transforms import FrameError
from torchelev.io.errors import RecordingError
from torchelev.io.folders.recording import Frame

_PERIODS = 0.02, 1.0  # [s] shortest and longest period of scans that is believed
_MAX_GAP = 1.0  # [s] between two poses without a warning
_LATE = "some scans are older than those before them, and are fused with dt = 0"


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
        self.topics = choose_topics(bag, types, request)
        self._num = sum(types[name].num for name in self.topics)
        period = bag.duration / max(1, max(types[name].num for name in self.topics) - 1)
        self._cameras = find_cameras(bag, types, request.depths)
        self.tree, self._covariances = read_poses(bag, request, types, float(np.clip(period, *_PERIODS)), show)
        sensor = self._first_frame()
        self.map_frame, self.base_frame = choose_frames(bag, self.tree, sensor, request)
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
        points = hold_still(self.tree, self.map_frame, scan)
        if points is None:
            self.notes[f"{scan.frame}: too few poses within a scan to take its motion out"] = None
            points = scan.points
        return Frame(points, T_map_sensor, max(0.0, dt), message.topic, T_map_base, covariance, scan.stamp)

    def _first_frame(self) -> str:
        """Return the frame of the first scan."""
        for message in self._bag.read(self.topics):
            return message.data.header.frame_id.lstrip("/")
        reason = self._bag.ended_early or f"no messages on {', '.join(self.topics)}"
        raise RecordingError(self._bag.path, reason, "choose another topic with --points or --depth")


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
