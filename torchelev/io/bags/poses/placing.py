"""Place the scans of a bag: read its poses, check their clocks and choose the frames, before scans are read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.bag import Bag
from torchelev.io.bags.covariance import PoseCovariances
from torchelev.io.bags.poses.clocks import ClockError, FirstScans, PoseClock
from torchelev.io.bags.poses.doubts import describe_jumps
from torchelev.io.bags.poses.frames import Frames, choose_frames, find_robot
from torchelev.io.bags.poses.lidar_odometry import add_lidar_odometry
from torchelev.io.bags.poses.missing import require_frames, require_way
from torchelev.io.bags.poses.names import is_world
from torchelev.io.bags.poses.reading import read_poses
from torchelev.io.bags.poses.rows import from_matrix, invert
from torchelev.io.bags.poses.spans import choose_span, read_first
from torchelev.io.bags.poses.transforms import TransformTree
from torchelev.io.bags.scans import clean
from torchelev.io.bags.topics import BagRequest
from torchelev.io.errors import RecordingError

_PERIODS = 0.02, 1.0  # [s] shortest and longest period of scans that is believed


class Placed(NamedTuple):
    """Where the scans of a recording are."""

    tree: TransformTree  #: of all frames
    covariances: PoseCovariances  #: of the base's pose
    map: str  #: frame of the map
    base: str  #: frame of the base
    sensor: str  #: frame of the first scan
    fixed: frozenset[str]  #: frames of clouds that are in the map's frame already
    rays_from: str  #: frame at which their rays start; "" if there are none
    span: tuple[float, float]  #: [s] mapped interval, by the time of recording
    clock: PoseClock  #: of the poses
    offsets: dict[str, float]  #: [s] by which the clocks of topics are to be set
    notes: list[str]  #: what is doubtful
    odometry_stamps: NDArray[np.float64] | None = None  #: (K,) [s] of the scans whose poses were found from clouds


def place_poses(bag: Bag, request: BagRequest, topics: Sequence[str], max_gap: float, show: Any = iter) -> Placed:
    """Read the poses of a bag, and find the frames of the map and the base.

    Args:
        bag: an open bag.
        request: what was asked for.
        topics: of the scans.
        max_gap: [s] between two poses without a note.
        show: wraps the iteration over the messages of poses.

    Raises:
        RecordingError: poses, frames or times are missing or could be several; the message names the option to give.
    """
    _require_topics(bag, request, topics)
    request = _clean_frames(request)
    tree, covariances = read_poses(bag, request, list(topics), _period(bag, topics), show)
    span, notes = choose_span(bag, request, tree)
    odometry_stamps = None
    if request.odometry:
        odometry_stamps, doubts = add_lidar_odometry(bag, request, topics, span, tree, show)
        notes += doubts
    scans = read_first(bag, request, topics, span)
    sensors = list(dict.fromkeys(one.frame for one in scans))
    request = _mount(bag, request, tree, sensors)
    require_frames(bag, request, tree, sensors)
    frames = choose_frames(bag.path, tree, sensors[0], request)
    for frame in (*sensors, frames.base):
        require_way(bag.path, tree, frames.map, frame)
    fixed = _find_fixed(bag, tree, frames, sensors, request)
    rays_from = (request.rays_from or frames.base) if fixed else ""
    _hold_constant(tree, frames.map, frames.base)
    clock = PoseClock(tree, frames.map, [frames.base, *sensors])
    offsets, differences = _compare_clocks(bag, clock, scans)
    notes += [
        *frames.notes,
        *differences,
        *clock.notes,
        *_doubt(bag, tree, frames, sensors, max_gap),
        *covariances.notes,
    ]
    names = frames.map, frames.base, sensors[0], fixed, rays_from
    return Placed(tree, covariances, *names, span, clock, offsets, notes, odometry_stamps)


def _clean_frames(request: BagRequest) -> BagRequest:
    """Return the request with names of frames as the tree has them, without a slash in front."""
    asked = (request.map_frame, request.base_frame, request.rays_from)
    map_frame, base_frame, rays_from = (clean(frame) if frame else None for frame in asked)
    return request._replace(map_frame=map_frame, base_frame=base_frame, rays_from=rays_from)


def _require_topics(bag: Bag, request: BagRequest, topics: Sequence[str]) -> None:
    unknown = [topic for topic in request.clock_offsets if topic and topic not in (*topics, request.semantic)]
    if unknown:
        reason = f"--clock-offset {unknown[0]}: is no topic of scans"
        raise RecordingError(bag.path, f"{reason}; these are {', '.join(topics)}")


def _period(bag: Bag, topics: Sequence[str]) -> float:
    """Return the shortest period of the topics' scans [s], by which poses may be extrapolated."""
    nums = [topic.num for topic in bag.topics if topic.name in topics]
    return float(np.clip(bag.duration / max(1, max(nums) - 1), *_PERIODS))


def _mount(bag: Bag, request: BagRequest, tree: TransformTree, sensors: list[str]) -> BagRequest:
    """Put the sensor on the base where its mounting was given, or the base below a sensor whose poses are known."""
    if request.T_base_sensor is None:
        return request
    sensor, base = sensors[0], request.base_frame or find_robot(tree)
    if len(sensors) > 1:
        reason = f"--extrinsics places one sensor, and there are {len(sensors)}: {', '.join(sensors)}"
        raise RecordingError(bag.path, reason, "give one topic with --points or --depth")
    if base is None:
        have = ", ".join(tree.frames) or "none"
        raise RecordingError(bag.path, f"--extrinsics: no frame moves; frames are {have}", "give --poses TOPIC")
    if base == sensor or (base not in tree.frames and sensor in tree.frames):
        base = "base_link" if base == sensor else base
        tree.add(sensor, base, 0.0, from_matrix(invert(request.T_base_sensor)), is_static=True)
    else:
        tree.replace(sensor)
        tree.add(base, sensor, 0.0, from_matrix(request.T_base_sensor), is_static=True)
    return request._replace(base_frame=base)


def _find_fixed(
    bag: Bag, tree: TransformTree, frames: Frames, sensors: list[str], request: BagRequest
) -> frozenset[str]:
    """Return those frames of clouds that stay in the map's frame, in which the base moves."""
    still = [f for f in sensors if f != frames.base and all(map(tree.is_constant, tree.way(frames.map, f)))]
    fixed = [f for f in still if f == frames.map or is_world(f) or request.rays_from]
    fixed = fixed if tree.moving_between(frames.map, frames.base) else []
    if request.rays_from and not fixed:
        reason = f"--rays-from {request.rays_from}: no cloud is in the map's frame {frames.map}"
        raise RecordingError(bag.path, f"{reason}; clouds are in {', '.join(sensors)}", "leave it out")
    return frozenset(fixed)


def _hold_constant(tree: TransformTree, map_frame: str, base: str) -> None:
    """Extend transforms that never change to all times, except those of a robot that stands still."""
    way = tree.way(map_frame, base)
    kept = [] if any(not tree.is_constant(frame) for frame in way) else way
    tree.hold(frame for frame in tree.frames if tree.parent(frame) and frame not in kept and tree.is_constant(frame))


def _compare_clocks(bag: Bag, clock: PoseClock, scans: list[FirstScans]) -> tuple[dict[str, float], list[str]]:
    """Compare the clocks of all topics with that of the poses; refuse if none has a pose."""
    found = {one.topic: clock.compare(one) for one in scans}
    differences = {topic: one for topic, one in found.items() if one is not None}
    offsets = {topic: one.offset for topic, one in differences.items() if one.offset is not None}
    notes = [one.sentence + (f"; give {one.cure}" if one.cure else "") for one in differences.values()]
    if len(differences) == len(scans) and any(one.is_hopeless for one in differences.values()):
        raise ClockError(bag.path, ". ".join([*clock.notes, *notes]), offsets)
    return offsets, notes


def _doubt(bag: Bag, tree: TransformTree, frames: Frames, sensors: list[str], max_gap: float) -> list[str]:
    """Return sentences on frames with several parents, and on gaps and jumps in the poses."""
    ends = (frames.base, *sensors)
    gaps = [line for end in ends for line in tree.describe_gaps(frames.map, end, max_gap)]
    moving = [frame for end in ends for frame in tree.moving_between(frames.map, end)]
    return [*tree.describe_conflicts(), *dict.fromkeys(gaps), *describe_jumps(tree, moving, bag.start)]
