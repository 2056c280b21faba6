"""Propose the command that maps a bag: the first with an option for everything that the bag leaves open."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator

from torchelev.io import RecordingError
from torchelev.io.bags import Bag, BagRecording, BagRequest, Topic, open_bag
from torchelev.io.bags.colors import field_names
from torchelev.io.bags.poses.clocks import ClockError
from torchelev.io.bags.poses.reading import ODOMETRY, POSE, TRANSFORMS
from torchelev.io.bags.scans import CLOUDS, IMAGES, LIDARS
from torchelev.io.bags.topics import depth_topics
from torchelev.io.points.colors import color_fields

_LABELS = re.compile("semantic|label|segment", re.IGNORECASE)


def propose(bag: Bag) -> list[str]:
    """Return the command that maps the bag with its first topic of clouds or depth images, or why there is none."""
    first: RecordingError | None = None
    for request in _requests(bag):
        try:
            request, recording = _open(bag, request)
        except RecordingError as error:
            first = first or error
            continue
        warnings = [f"warning: {note}" for note in recording.pose_notes]
        return ["to map it", f"  {_command(bag, recording, request)}", *_propose_channels(bag, request), *warnings]
    found = ["it cannot be mapped without more options:", f"  {first}"]
    return [*found, *_propose_odometry(bag)]


def _propose_channels(bag: Bag, request: BagRequest) -> list[str]:
    """Return a line for colours of the points, and one for a topic of images that may hold class labels."""
    lines = []
    if any(color_fields(field_names(bag, topic)) for topic in request.clouds):
        lines.append("the points have colours, which --colour maps")
    images = [topic.name for topic in bag.topics if topic.type in IMAGES and topic.num]
    named = next((name for name in images if _LABELS.search(name)), None)
    return lines + ([] if named is None else [f"class labels are mapped with --semantic {named}"])


def _propose_odometry(bag: Bag) -> list[str]:
    """Return the command that finds poses from the clouds of a bag that has none."""
    topic = next(iter(_choose_sensor(bag.topics).clouds), None)
    kinds = {one.name: one.type for one in bag.topics}
    if topic is None or kinds[topic] not in LIDARS or any(kind in (ODOMETRY, POSE) for kind in kinds.values()):
        return []
    words = ["torchelev", "map", str(bag.path), "--points", topic, "--odometry", "kiss-icp"]
    imu = next((one.name for one in bag.topics if one.type == "sensor_msgs/msg/Imu" and one.num), None)
    words += ["--imu", imu] if imu else []
    return ["its poses can be found from the clouds of a 3-D lidar, see torchelev[odometry]:", f"  {shlex.join(words)}"]


def _requests(bag: Bag) -> Iterator[BagRequest]:
    """Yield candidate requests: with the transforms, with each odometry, and with that as each likely frame's pose."""
    plain = _choose_sensor(bag.topics)
    yield plain
    transforms = [topic.name for topic in bag.topics if topic.type in TRANSFORMS and topic.num]
    spaces = {name.rsplit("/", 1)[0] for name in transforms} - {""}
    if len(spaces) == 1:  # of several robots, only the user knows the one that is meant
        yield plain._replace(transforms=tuple(name for name in transforms if name.startswith(f"{min(spaces)}/")))
    for topic in bag.topics:
        if topic.type == ODOMETRY and topic.num:
            yield plain._replace(poses=topic.name)
            for base in ("base_link", "base_footprint", "body"):
                yield plain._replace(poses=topic.name, base_frame=base)


def _choose_sensor(topics: list[Topic]) -> BagRequest:
    names = {kind: [topic.name for topic in topics if topic.type == kind and topic.num] for kind in CLOUDS}
    clouds = next((found for found in names.values() if found), [])
    return BagRequest(clouds=clouds[:1], depths=[] if clouds else depth_topics(topics)[:1])


def _open(bag: Bag, request: BagRequest) -> tuple[BagRequest, BagRecording]:
    """Open the scans, with the clocks of sensors set if they differ from that of the poses."""
    try:
        recording = open_bag(bag, request)
        offsets = recording.clock_offsets
    except ClockError as error:
        if not error.offsets:
            if request.stamps == "recorded":
                raise
            return _open(bag, request._replace(stamps="recorded"))
        offsets = error.offsets
    if not offsets:
        return request, recording
    request = request._replace(clock_offsets=offsets)
    return request, open_bag(bag, request)


def _command(bag: Bag, recording: BagRecording, request: BagRequest) -> str:
    words = ["torchelev", "map", str(bag.path)]
    words += [word for name in request.clouds for word in ("--points", name)]
    words += [word for name in request.depths for word in ("--depth", name)]
    words += [word for name in request.transforms for word in ("--tf", name)]
    words += ["--poses", request.poses] if request.poses else []
    words += [
        word for topic, offset in request.clock_offsets.items() for word in ("--clock-offset", f"{topic}={offset!r}")
    ]
    words += ["--stamps", "recorded"] if request.stamps == "recorded" else []
    words += ["--map-frame", recording.map_frame, "--base-frame", recording.base_frame]
    words += ["--rays-from", recording.rays_from] if recording.rays_from else []
    return shlex.join(words)
