"""Which time of a bag is mapped, and the first scans in it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.bag import Bag
from torchelev.io.bags.poses.clocks import FirstScans
from torchelev.io.bags.poses.reading import time_of
from torchelev.io.bags.poses.transforms import TransformTree
from torchelev.io.bags.scans import clean
from torchelev.io.bags.topics import BagRequest
from torchelev.io.errors import RecordingError

_BACK = 0.5  # [s] by which stamps of one sender go back only if its clock does
_AHEAD = 5.0  # [s] more than the time between two recordings: the clock was set
_MANY = 20  # more steps back are two senders, each with its clock
_FIRST = 5  # scans of a topic whose stamps are looked at


def choose_span(bag: Bag, request: BagRequest, tree: TransformTree) -> tuple[tuple[float, float], list[str]]:
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


def _read_first(bag: Bag, request: BagRequest, topic: str, span: tuple[float, float]) -> FirstScans:
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


def read_first(bag: Bag, request: BagRequest, topics: Sequence[str], span: tuple[float, float]) -> list[FirstScans]:
    """Read the first scans of all topics that have some in a time.

    Raises:
        RecordingError: none has.
    """
    scans = [_read_first(bag, request, topic, span) for topic in topics]
    found = [one for one in scans if len(one.stamps)]
    if not found:
        words = {"after --start": request.start, "before --end": request.end}
        times = [f" {key} {value:g}" for key, value in words.items() if value is not None]
        reason = bag.ended_early or f"no messages on {', '.join(topics)}{' and'.join(times)}"
        raise RecordingError(bag.path, reason, "choose another topic with --points or --depth")
    return found


def find_restarts(tree: TransformTree) -> tuple[list[tuple[float, str]], list[str]]:
    """Find where the clock of the transforms goes back, or jumps ahead.

    Returns:
        When that was recorded [s] with a sentence, in order; and notes on frames whose stamps go back again and again.
    """
    restarts: list[tuple[float, str]] = []
    notes = []
    for frame in tree.frames:
        if tree.parent(frame) is None or tree.is_constant(frame):
            continue
        rows = tree.recorded_rows(frame)
        steps = np.diff(rows[:, 0])
        is_back = steps < -_BACK
        is_ahead = steps > _AHEAD + 100 * np.abs(np.diff(rows[:, -1]))
        if is_back.sum() > _MANY:
            notes.append(
                f"stamps of {frame} go back {is_back.sum()} times: two nodes with different clocks send its "
                "transforms; give --poses TOPIC, or --tf TOPIC"
            )
            continue
        for index in np.flatnonzero((is_back | is_ahead) & np.isfinite(rows[1:, -1])):
            restarts.append(
                (float(rows[index + 1, -1]), _describe(frame, rows[:, 0], int(index), bool(is_back[index])))
            )
    return sorted(restarts), notes


def _describe(frame: str, stamps: NDArray[np.float64], index: int, is_back: bool) -> str:
    before, after = stamps[: index + 1], stamps[index + 1 :]
    verb = "goes back" if is_back else "jumps ahead"
    return (
        f"the clock {verb} by {abs(stamps[index + 1] - stamps[index]):,.1f} s: stamps of {frame} "
        f"{before.min():,.3f} .. {before.max():,.3f} s are followed by {after.min():,.3f} .. {after.max():,.3f} s"
    )


def choose_run(start: float, end: float, restarts: list[tuple[float, str]]) -> tuple[float, float]:
    """Return the longest time [s] between restarts of the clock, as it was recorded."""
    bounds = [start, *(time for time, _ in restarts), end]
    runs = list(zip(bounds, bounds[1:], strict=False))
    return max(runs, key=lambda run: run[1] - run[0])
