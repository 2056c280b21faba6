"""`torchelev bag`: list what a bag holds, and propose how to map it."""

from __future__ import annotations

import contextlib
from pathlib import Path

from torchelev.app.bag.proposal import propose
from torchelev.app.mapping.fuse_scans import show_progress
from torchelev.app.results import align
from torchelev.io import RecordingError
from torchelev.io.bags import Bag, BagRequest, Topic
from torchelev.io.bags.poses.drawing import draw_tree
from torchelev.io.bags.poses.reading import TRANSFORMS, add_transforms, choose_transforms, is_static_topic
from torchelev.io.bags.poses.transforms import TransformTree
from torchelev.io.bags.scans import CLOUDS, IMAGES

_TIMED = 20  # messages that give a topic's rate
_HAVE_FRAMES = (*CLOUDS, *IMAGES, "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped")


def describe_bag(path: Path) -> str:
    """Return topics, types, counts, rates and frames of a bag, its tree of transforms, and the command to map it.

    Raises:
        RecordingError: the bag cannot be read.
    """
    with Bag(path) as bag:
        rows = [("topic", "type", "messages", "Hz", "frame")] + [_row(bag, topic) for topic in bag.topics]
        rows += [(topic.name, topic.type, f"{topic.num:,}", "", f"not read: {topic.problem}") for topic in bag.unread]
        tree = _read_tree(bag)
        lines = [f"{path}: {bag.duration:.1f} s", "", *align(rows), "", "transforms"]
        lines += [f"  {line}" for line in draw_tree(tree)] or ["  none"]
        lines += ["", *propose(bag)]
        return "\n".join(lines + ([f"warning: {bag.ended_early}"] if bag.ended_early else []))


def _row(bag: Bag, topic: Topic) -> tuple[str, str, str, str, str]:
    rate = "" if topic.type in TRANSFORMS and is_static_topic(topic.name) else _rate(bag.read_times(topic.name, _TIMED))
    first = next(bag.read([topic.name]), None) if topic.type in _HAVE_FRAMES else None
    frame = "" if first is None else first.data.header.frame_id
    return topic.name, topic.type, f"{topic.num:,}", rate, frame


def _rate(times: list[float]) -> str:
    """Return the messages a second at these times [s], or "" where there are too few."""
    spacing = (times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else 0.0
    return f"{1 / spacing:.1f}" if spacing > 0 else ""


def _read_tree(bag: Bag) -> TransformTree:
    """Return the tree of all transforms: those that are mapped with, or if these must be chosen, of all topics."""
    topics = [topic.name for topic in bag.topics if topic.type in TRANSFORMS]
    with contextlib.suppress(RecordingError):
        topics = choose_transforms(bag, BagRequest(), [topic.name for topic in bag.topics if topic.type in CLOUDS])
    tree = TransformTree()
    for message in show_progress(bag.read(topics), "reading transforms", "message"):
        add_transforms(tree, message, BagRequest())
    return tree
