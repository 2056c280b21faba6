"""`torchelev bag`: list what a bag holds, and propose how to map it."""

from __future__ import annotations

import shlex
from pathlib import Path

from torchelev.app.mapping.fuse_scans import show_progress
from torchelev.app.results import align
from torchelev.io import RecordingError
from torchelev.io.bags import Bag, BagRecording, BagRequest, Topic, open_bag
from torchelev.io.bags.poses.reading import TRANSFORMS
from torchelev.io.bags.scans import CLOUDS, IMAGES
from torchelev.io.bags.transforms import TransformTree

_TIMED = 20  # messages that give a topic's rate
_HAVE_FRAMES = (*CLOUDS, *IMAGES, "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped")


def describe_bag(path: Path) -> str:
    """Return topics, types, counts, rates and frames of a bag, its tree of transforms, and the command to map it.

    Raises:
        RecordingError: the bag cannot be read.
    """
    with Bag(path) as bag:
        rows = [("topic", "type", "messages", "Hz", "frame")] + [_row(bag, topic) for topic in bag.topics]
        tree = _read_tree(bag)
        lines = [f"{path}: {bag.duration:.1f} s", "", *align(rows), "", "transforms"]
        lines += [f"  {line}" for line in tree.draw()] or ["  none"]
        lines += ["", *_propose(bag)]
        return "\n".join(lines + ([f"warning: {bag.ended_early}"] if bag.ended_early else []))


def _row(bag: Bag, topic: Topic) -> tuple[str, str, str, str, str]:
    rate = "" if TRANSFORMS.get(topic.name) else _rate(bag.read_times(topic.name, _TIMED))
    first = next(bag.read([topic.name]), None) if topic.type in _HAVE_FRAMES else None
    frame = "" if first is None else first.data.header.frame_id
    return topic.name, topic.type, f"{topic.num:,}", rate, frame


def _rate(times: list[float]) -> str:
    """Return the messages a second at these times [s], or "" where there are too few."""
    spacing = (times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else 0.0
    return f"{1 / spacing:.1f}" if spacing > 0 else ""


def _read_tree(bag: Bag) -> TransformTree:
    tree = TransformTree()
    for message in show_progress(bag.read(list(TRANSFORMS)), "reading transforms", "message"):
        tree.add_message(message.data, TRANSFORMS[message.topic])
    return tree


def _propose(bag: Bag) -> list[str]:
    """Return the command that maps the bag with its first topic of clouds or depth images, or why there is none."""
    names = {kind: [topic.name for topic in bag.topics if topic.type == kind and topic.num] for kind in CLOUDS}
    clouds = next((found for found in names.values() if found), [])
    depths = [topic.name for topic in bag.topics if topic.type in IMAGES and "depth" in topic.name]
    request = BagRequest(clouds=clouds[:1], depths=[] if clouds else depths[:1])
    try:
        recording = open_bag(bag, request)
        warnings = [f"warning: {note}" for note in recording.pose_notes]
        return ["to map it", f"  {_command(bag, recording, request)}", *warnings]
    except RecordingError as error:
        return ["it cannot be mapped without more options:", f"  {error}"]


def _command(bag: Bag, recording: BagRecording, request: BagRequest) -> str:
    words = ["torchelev", "map", str(bag.path)]
    words += [word for name in request.clouds for word in ("--points", name)]
    words += [word for name in request.depths for word in ("--depth", name)]
    return shlex.join([*words, "--map-frame", recording.map_frame, "--base-frame", recording.base_frame])
