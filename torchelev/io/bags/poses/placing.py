"""Place the scans of a bag: read its poses, check their clocks and choose the frames, before scans are read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from torchelev.io.bags.bag import Bag
from torchelev.io.bags.covariance import PoseCovariances
from torchelev.io.bags.poses.clocks import ClockError, FirstScans, choose_run, compare_clocks, find_restarts
from torchelev.io.bags.poses.doubts import describe_jumps
from torchelev.io.bags.poses.frames import choose_frames, find_robot
from torchelev.io.bags.poses.missing import require_frames, require_way
from torchelev.io.bags.poses.names import is_world
from torchelev.io.bags.poses.reading import read_poses, time_of
from torchelev.io.bags.poses.rows import from_matrix
from torchelev.io.bags.poses.transforms import TransformTree
from torchelev.io.bags.scans import clean
from torchelev.io.bags.topics import BagRequest
from torchelev.io.errors import RecordingError

_PERIODS = 0.02, 1.0  # [s] shortest and longest period of scans that is believed
_FIRST = 5  # scans of a topic whose stamps are looked at


class Placed(NamedTuple):
    """Where the scans of a recording are."""

    tree: TransformTree  #: of all frames
    covariances: PoseCovariances  #: of the base's pose
    map: str  #: frame of the map
    base: str  #: frame of the base
    sensor: str  #: frame of the first scan
    fixed: frozenset[str]  #: frames of clouds that are in the map's frame already
    rays_from: str  #: frame at which their rays start; "" if there are none
    span: tuple[float, float]  #: [s] what is mapped, by the time of recording
    offsets: dict[str, float]  #: [s] by which the clocks of topics are to be set
    notes: list[str]  #: what is doubtful


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
    unknown = [topic for topic in request.clock_offsets if topic and topic not in topics]
    if unknown:
        reason = f"--clock-offset {unknown[0]}: is no topic of scans"
        raise RecordingError(bag.path, f"{reason}; these are {', '.join(topics)}")
    tree, covariances = read_poses(bag, request, list(topics), _period(bag, topics), show)
    span, notes = _choose_span(bag, request, tree)
    scans = [_first_scans(bag, request, topic, span) for topic in topics]
    scans = _require_scans(bag, request, topics, [one for one in scans if len(one.stamps)])
    sensors = list(dict.fromkeys(one.frame for one in scans))
    _mount(bag, request, tree, sensors)
    require_frames(bag, request, tree, sensors)
    frames = choose_frames(bag.path, tree, sensors[0], request)
    for sensor in sensors:
        require_way(bag.path, tree, frames.map, sensor)
    require_way(bag.path, tree, frames.map, frames.base)
    fixed = _find_fixed(tree, frames.map, frames.base, sensors, request)
    if request.rays_from and not fixed:
        reason = f"--rays-from {request.rays_from}: no cloud is in the map's frame {frames.map}"
        raise RecordingError(bag.path, f"{reason}; clouds are in {', '.join(sensors)}", "leave it out")
    _hold_constant(tree, frames.map, frames.base)
    ways = [frame for end in (frames.base, *sensors) for frame in tree.moving_between(frames.map, end)]
    offsets, clocks = _check_clocks(bag, tree, frames.map, frames.base, scans)
    gaps = [line for end in (frames.base, *sensors) for line in tree.describe_gaps(frames.map, end, max_gap)]
    jumps = describe_jumps(tree, ways, bag.start)
    notes += [*frames.notes, *clocks, *tree.describe_conflicts(), *dict.fromkeys(gaps), *jumps, *covariances.notes]
    rays_from = (request.rays_from or frames.base) if fixed else ""
    return Placed(tree, covariances, frames.map, frames.base, sensors[0], fixed, rays_from, span, offsets, notes)


def _period(bag: Bag, topics: Sequence[str]) -> float:
    """Return the shortest period of the topics' scans [s], by which poses may be extrapolated."""
    nums = [topic.num for topic in bag.topics if topic.name in topics]
    return float(np.clip(bag.duration / max(1, max(nums) - 1), *_PERIODS))


def _choose_span(bag: Bag, request: BagRequest, tree: TransformTree) -> tuple[tuple[float, float], list[str]]:
    """Return what is mapped [s], by the time of recording, and drop other poses; with notes on clocks that restart."""
    start = -np.inf if request.start is None else bag.start + request.start
    end = np.inf if request.end is None else bag.start + request.end
    if start >= end:
        raise RecordingError(bag.path, f"--start {request.start} is not before --end {request.end}", "give seconds")
    tree.keep_recorded(start, end)
    restarts, notes = find_restarts(tree)
    if restarts:
        bag_end = bag.start + bag.duration
        start, end = choose_run(max(start, bag.start), min(end, bag_end + 1e-6), restarts)
        others = [f"--start {time - bag.start:.3f}" for time, _ in restarts]
        notes.append(
            f"{restarts[0][1]}; only the {end - start:.1f} s from {max(0.0, start - bag.start):.3f} s after the bag's "
            f"start are mapped; give --start and --end to choose others, such as {others[0]}"
        )
        end = float(np.nextafter(end, -np.inf))
        tree.keep_recorded(start, end)
    return (start, end), notes


def _first_scans(bag: Bag, request: BagRequest, topic: str, span: tuple[float, float]) -> FirstScans:
    """Read the first scans of a topic."""
    stamps, recorded, frame = [], [], ""
    for message in bag.read([topic]):
        if span[0] <= message.time <= span[1]:
            frame = frame or clean(message.data.header.frame_id)
            stamps.append(time_of(message, request))
            recorded.append(message.time)
        if len(stamps) == _FIRST or message.time > span[1]:
            break
    offset = request.clock_offsets.get(topic, request.clock_offsets.get("", 0.0))
    end = min(span[1], bag.start + bag.duration)
    return FirstScans(topic, frame, np.array(stamps), np.array(recorded), offset, end)


def _require_scans(bag: Bag, request: BagRequest, topics: Sequence[str], scans: list[FirstScans]) -> list[FirstScans]:
    if not scans:
        times = [
            f" {word} --{key} {value:g}"
            for key, word, value in (("start", "after", request.start), ("end", "before", request.end))
            if value is not None
        ]
        reason = bag.ended_early or f"no messages on {', '.join(topics)}{' and'.join(times)}"
        raise RecordingError(bag.path, reason, "choose another topic with --points or --depth")
    return scans


def _mount(bag: Bag, request: BagRequest, tree: TransformTree, sensors: list[str]) -> None:
    """Put the sensor on the base where its mounting was given."""
    if request.T_base_sensor is None:
        return
    if len(sensors) > 1:
        reason = f"--extrinsics places one sensor, and there are {len(sensors)}: {', '.join(sensors)}"
        raise RecordingError(bag.path, reason, "give one topic with --points or --depth")
    tree.replace(sensors[0])
    base = request.base_frame or find_robot(tree)
    if base is None:
        have = ", ".join(tree.frames) or "none"
        raise RecordingError(
            bag.path, f"--extrinsics: no frame moves; frames are {have}", "give --poses or --base-frame"
        )
    tree.add(base, sensors[0], 0.0, from_matrix(request.T_base_sensor), is_static=True)


def _find_fixed(
    tree: TransformTree, map_frame: str, base: str, sensors: list[str], request: BagRequest
) -> frozenset[str]:
    """Return those frames of clouds that stay in the map's frame, in which the base moves."""
    if not tree.moving_between(map_frame, base):
        return frozenset()
    still = [f for f in sensors if f != base and all(tree.is_constant(way) for way in tree.way(map_frame, f))]
    return frozenset(f for f in still if f == map_frame or is_world(f) or request.rays_from)


def _hold_constant(tree: TransformTree, map_frame: str, base: str) -> None:
    """Let transforms that never change hold at all times; those of a robot that stands still only at their times."""
    way = tree.way(map_frame, base)
    kept = [] if any(not tree.is_constant(frame) for frame in way) else way
    tree.hold(frame for frame in tree.frames if tree.parent(frame) and frame not in kept and tree.is_constant(frame))


def _check_clocks(
    bag: Bag, tree: TransformTree, map_frame: str, base: str, scans: list[FirstScans]
) -> tuple[dict[str, float], list[str]]:
    """Compare the clocks of all topics with that of the poses; refuse if one has no pose at all."""
    offsets: dict[str, float] = {}
    notes, hopeless = [], False
    for one in scans:
        frames = list(dict.fromkeys(tree.moving_between(map_frame, base) + tree.moving_between(map_frame, one.frame)))
        found = compare_clocks(tree, frames, one)
        if found is not None:
            offsets |= {} if found.offset is None else {one.topic: found.offset}
            notes.append("; give ".join([found.sentence, *([found.cure] if found.cure else [])]))
            hopeless |= found.is_hopeless
    if hopeless and len(notes) == len(scans):
        raise ClockError(bag.path, ". ".join(notes), offsets)
    return offsets, notes
