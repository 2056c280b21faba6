"""Read the poses of a bag: its transforms, and a topic of poses in their place."""

from __future__ import annotations

from typing import Any, NamedTuple

from torchelev.io.bags.bag import Bag, Topic
from torchelev.io.bags.covariance import PoseCovariances
from torchelev.io.bags.topics import BagRequest, name_topics
from torchelev.io.bags.transforms import TransformTree
from torchelev.io.errors import RecordingError

ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
TRANSFORMS = {"/tf": False, "/tf_static": True}  # topic -> whether its transforms are static


class Poses(NamedTuple):
    """Where everything was over a recording."""

    tree: TransformTree  #: of all frames
    covariances: PoseCovariances  #: of the base's pose; may be empty


def read_poses(
    bag: Bag, request: BagRequest, types: dict[str, Topic], max_extrapolation: float, show: Any = iter
) -> Poses:
    """Read all transforms, and the poses of the requested topic in their place.

    Args:
        bag: an open bag.
        request: names the topic of poses.
        types: the bag's topics by name.
        max_extrapolation: [s] by which a time may lie outside of a transform's stamps.
        show: wraps the iteration over the messages, for a progress bar.

    Raises:
        RecordingError: there is no such topic of poses, or it does not say whose poses it holds.
    """
    _check_poses(bag, request, types)
    poses = Poses(TransformTree(max_extrapolation), PoseCovariances())
    for message in show(bag.read([*TRANSFORMS, *([request.poses] if request.poses else [])])):
        if message.topic in TRANSFORMS:
            poses.tree.add_message(message.data, TRANSFORMS[message.topic])
        elif types[message.topic].type == ODOMETRY:
            poses.tree.add_odometry(message.data)
            poses.covariances.add(message.data)
        else:
            poses.tree.add_pose(message.data, str(request.base_frame))
    return poses


def _check_poses(bag: Bag, request: BagRequest, types: dict[str, Topic]) -> None:
    """Refuse a topic of poses that is not there, is of another type or leaves the frame open."""
    if request.poses is None:
        return
    kind = types[request.poses].type if request.poses in types else "not in the bag"
    if kind not in (ODOMETRY, POSE):
        have = name_topics([t for t in types.values() if t.type in (ODOMETRY, POSE)])
        raise RecordingError(bag.path, f"--poses {request.poses} is {kind}", f"topics of poses are {have}")
    if kind == POSE and request.base_frame is None:
        raise RecordingError(bag.path, f"{request.poses} does not say whose pose it is", "give --base-frame")
