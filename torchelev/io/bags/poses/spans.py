"""Which time of a bag is mapped, and the first scans in it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchelev.io.bags.bag import Bag
from torchelev.io.bags.poses.clocks import FirstScans, choose_run, find_restarts
from torchelev.io.bags.poses.reading import time_of
from torchelev.io.bags.poses.transforms import TransformTree
from torchelev.io.bags.scans import clean
from torchelev.io.bags.topics import BagRequest
from torchelev.io.errors import RecordingError

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
