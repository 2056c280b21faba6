"""Errors for frames that are missing or not connected, with the options that supply them."""

from __future__ import annotations

from pathlib import Path

from torchelev.io.bags.bag import Bag
from torchelev.io.bags.poses.frames import find_robot
from torchelev.io.bags.poses.reading import ODOMETRY, POSE, TRANSFORMS, choose_transforms
from torchelev.io.bags.poses.transforms import FrameError, TransformTree
from torchelev.io.bags.scans import LIDARS
from torchelev.io.bags.topics import BagRequest
from torchelev.io.errors import RecordingError


def require_frames(bag: Bag, request: BagRequest, tree: TransformTree, sensors: list[str]) -> None:
    """Raise a RecordingError if a frame that was asked for, or that of a sensor, is not among the transforms."""
    for frame in (request.map_frame, request.base_frame, request.rays_from, *sensors):
        if frame is not None and frame not in tree.frames:
            have = ", ".join(tree.frames) or "none"
            is_asked = frame not in sensors
            choose = f"choose one of them{_other_transforms(bag, request)}"
            hint = choose if is_asked and tree.frames else _hint(bag, request, tree, frame)
            raise RecordingError(bag.path, f"the transforms have no frame {frame}; frames are {have}", hint)


def require_way(path: Path, tree: TransformTree, map_frame: str, frame: str) -> None:
    """Raise a RecordingError if no transforms connect a frame with the map's."""
    if set(tree.ancestors(map_frame)) & set(tree.ancestors(frame)):
        return
    problem = FrameError(tree.explain(map_frame, frame))
    raise RecordingError(
        path, str(problem), "give --map-frame and --base-frame, or --extrinsics for the sensor's place"
    )


def _hint(bag: Bag, request: BagRequest, tree: TransformTree, sensor: str) -> str:
    """Return the options that say where a sensor is."""
    robot = find_robot(tree)
    if tree.frames and robot:
        return f"give --extrinsics with the pose of {sensor} on {robot}{_other_transforms(bag, request)}"
    odometry = [topic.name for topic in bag.topics if topic.type == ODOMETRY and topic.num]
    poses = [topic.name for topic in bag.topics if topic.type == POSE and topic.num]
    if odometry and not request.poses:
        return f"give --poses {odometry[0]}, and --extrinsics with the pose of {sensor} on the base"
    if poses and not request.poses:
        return f"give --poses {poses[0]} --base-frame {sensor} if these are the poses of {sensor}"
    has_lidar = any(topic.type in LIDARS and topic.num for topic in bag.topics)
    clouds = ", or --odometry kiss-icp to find poses from the clouds" if has_lidar else ""
    return f"give --poses TOPIC if the bag holds Odometry{clouds}{_other_transforms(bag, request)}"


def _other_transforms(bag: Bag, request: BagRequest) -> str:
    """Name the topics of transforms that are not read."""
    used = choose_transforms(bag, request, [])
    unused = [topic.name for topic in bag.topics if topic.type in TRANSFORMS and topic.num and topic.name not in used]
    return f", or {' '.join(f'--tf {name}' for name in unused)}" if unused else ""
