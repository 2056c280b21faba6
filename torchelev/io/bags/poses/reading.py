"""Read the poses of a bag: its transforms, and a topic of poses in their place."""

from __future__ import annotations

from typing import Any, NamedTuple

from torchelev.io.bags.bag import Bag, Message, Topic
from torchelev.io.bags.covariance import PoseCovariances
from torchelev.io.bags.poses.rows import pose_numbers
from torchelev.io.bags.poses.transforms import TransformTree
from torchelev.io.bags.scans import clean, stamp_of
from torchelev.io.bags.topics import BagRequest, name_topics
from torchelev.io.errors import RecordingError

ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


class Poses(NamedTuple):
    """The poses of all frames over a recording."""

    tree: TransformTree  #: of all frames
    covariances: PoseCovariances  #: of the base's pose; may be empty


def read_poses(bag: Bag, request: BagRequest, scans: list[str], max_extrapolation: float, show: Any = iter) -> Poses:
    """Read all transforms, and the poses of the requested topic in their place.

    Args:
        bag: an open bag.
        request: names topics and times.
        scans: topics of the scans; transforms of their namespace are read where there is no /tf.
        max_extrapolation: [s] by which a time may lie outside of a transform's stamps.
        show: wraps the iteration over the messages, for a progress bar.

    Raises:
        RecordingError: there is no such topic of poses, or it does not say whose poses it holds.
    """
    types = {topic.name: topic for topic in bag.topics}
    poses = Poses(TransformTree(max_extrapolation), PoseCovariances(request.poses or ""))
    transforms = choose_transforms(bag, request, scans)
    _check_poses(bag, request, types)
    for message in show(bag.read([*transforms, *([request.poses] if request.poses else [])])):
        if message.topic in transforms:
            add_transforms(poses.tree, message, request)
        else:
            _add_pose(bag, poses, message, types[message.topic].type == ODOMETRY, request)
    poses.tree.drop_circles()
    return poses


def is_static_topic(topic: str) -> bool:
    """Return whether the transforms of a topic hold from then on: /tf_static, /robot1/tf_static."""
    return topic.endswith("static")


def time_of(message: Message, request: BagRequest) -> float:
    """Return the time [s] of a message with a header: its stamp, or when it was recorded."""
    return message.time if request.stamps == "recorded" else stamp_of(message.data.header)


def add_transforms(tree: TransformTree, message: Message, request: BagRequest) -> None:
    """Add the transforms of a TFMessage, unless others take their place."""
    is_static = is_static_topic(message.topic)
    for one in message.data.transforms:
        if not tree.is_replaced(one.child_frame_id):
            pose = pose_numbers(one.transform.translation, one.transform.rotation)
            stamp = message.time if request.stamps == "recorded" else stamp_of(one.header)
            tree.add(one.header.frame_id, one.child_frame_id, stamp, pose, is_static, message.time)


def _add_pose(bag: Bag, poses: Poses, message: Message, is_odometry: bool, request: BagRequest) -> None:
    """Add an Odometry or a PoseStamped, in place of that frame's transforms."""
    data, stamp = message.data, time_of(message, request)
    named = clean(data.child_frame_id) if is_odometry else ""
    child = named or clean(request.base_frame or "")
    if not child:
        raise RecordingError(bag.path, f"{message.topic} does not say whose pose it is", "give --base-frame")
    pose = data.pose.pose if is_odometry else data.pose
    poses.tree.replace(child)
    row = pose_numbers(pose.position, pose.orientation)
    poses.tree.add(data.header.frame_id, child, stamp, row, recorded=message.time)
    if is_odometry:
        poses.covariances.add(data, stamp)


def choose_transforms(bag: Bag, request: BagRequest, scans: list[str]) -> list[str]:
    """Return the requested topics of transforms; else /tf and /tf_static; else those of the scans' namespace."""
    have = [topic.name for topic in bag.topics if topic.type in TRANSFORMS and topic.num]
    for name in request.transforms:
        if name not in have:
            raise RecordingError(
                bag.path, f"--tf {name} holds no transforms", f"topics of transforms are {_join(have)}"
            )
    if request.transforms:
        return list(request.transforms)
    plain: list[str] = [name for name in ("/tf", "/tf_static") if name in have]
    spaces = sorted({_namespace(name) for name in have if not is_static_topic(name)} - {""})
    if "/tf" in plain or not spaces:
        return plain if "/tf" in plain else have  # Foxglove's transforms are on any topic
    near = [space for space in spaces if scans and scans[0].startswith(f"{space}/")] or spaces
    if len(near) > 1:
        raise RecordingError(bag.path, f"transforms are on {_join(have)}", "choose them with --tf TOPIC, repeated")
    return [*plain, *(name for name in have if _namespace(name) == near[0])]


def _namespace(topic: str) -> str:
    return topic.rsplit("/", 1)[0]


def _join(names: list[str]) -> str:
    return ", ".join(names) or "none"


def _check_poses(bag: Bag, request: BagRequest, types: dict[str, Topic]) -> None:
    """Refuse a topic of poses that is missing, has another type or does not name the frame."""
    if request.poses is None:
        return
    kind = types[request.poses].type if request.poses in types else "not in the bag"
    if kind not in (ODOMETRY, POSE):
        have = name_topics([t for t in types.values() if t.type in (ODOMETRY, POSE)])
        raise RecordingError(bag.path, f"--poses {request.poses} is {kind}", f"topics of poses are {have}")
    if kind == POSE and request.base_frame is None:
        raise RecordingError(bag.path, f"{request.poses} does not say whose pose it is", "give --base-frame")
