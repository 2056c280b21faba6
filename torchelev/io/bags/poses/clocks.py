"""Clocks that differ, restart or were never set: found before mapping, from stamps and the times of recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.poses.transforms import TransformTree
from torchelev.io.errors import RecordingError

_BACK = 0.5  # [s] by which stamps of one sender go back only if its clock does
_AHEAD = 5.0  # [s] more than the time between two recordings: the clock was set
_MANY = 20  # more steps back are two senders, each with its clock
_DIFFERENCE = 1.0  # [s] between two clocks; delays of sensors are shorter
_SNAP = 0.3  # [s] to a difference of time scales or zones
_SCALES = np.array([18.0, 19.0, 37.0])  # GPS - UTC, TAI - GPS, TAI - UTC
_ZONE = 1800.0  # [s]


class FirstScans(NamedTuple):
    """The first scans of a topic."""

    topic: str  #: its name
    frame: str  #: of the first one
    stamps: NDArray[np.float64]  #: (K,) [s], without the offset
    recorded: NDArray[np.float64]  #: (K,) [s] when they were recorded
    offset: float  #: [s] that is added to the topic's stamps
    end: float  #: [s] when the bag ends, by the time of recording


class Difference(NamedTuple):
    """Two clocks that differ."""

    sentence: str  #: both ranges
    cure: str  #: the options that align the clocks; "" if none is known
    offset: float | None  #: [s] to add to the stamps of the topic; None: unknown
    is_hopeless: bool  #: no scan has a pose without it


class ClockError(RecordingError):
    """No scan lies within the times of the poses.

    Attributes:
        offsets: [s] to add to the stamps of topics; topics whose offset is unknown are not in it.
    """

    def __init__(self, path: Path, problem: str, offsets: dict[str, float]) -> None:
        super().__init__(path, problem)
        self.offsets = offsets


def compare_clocks(tree: TransformTree, frames: Sequence[str], scans: FirstScans) -> Difference | None:
    """Compare the stamps of a topic's scans with those of the moving frames that their poses need.

    Stamps that were recorded at the same time differ by a clock's offset and short delays. If the times of recording
    say nothing, as they lie apart, the ranges of the stamps do.
    """
    rows = [tree.recorded_rows(frame) for frame in frames]
    rows = [row for row in rows if len(row) > 1]
    if not rows or not len(scans.stamps):
        return None
    low = max(float(row[:, 0].min()) for row in rows)
    high = min(float(row[:, 0].max()) for row in rows)
    first = float(scans.stamps.min()) + scans.offset
    last = first + max(0.0, scans.end - float(scans.recorded[0]))
    told = (
        f"stamps of {scans.topic} are {first:,.3f} .. {last:,.3f} s, those of "
        f"{', '.join(frames)} {low:,.3f} .. {high:,.3f} s"
    )
    is_apart = last < low - _DIFFERENCE or first > high + _DIFFERENCE
    if is_apart and not scans.stamps.any():
        return Difference(f"{told}: those of {scans.topic} were never filled in", "--stamps recorded", None, True)
    if is_apart and any(not row[:, 0].any() for row in rows):
        return Difference(f"{told}: those of the poses were never filled in", "--stamps recorded", None, True)
    offset = _measure(rows[0], scans)
    if offset is None or abs(offset) < _DIFFERENCE:
        return Difference(f"{told}: no scan lies within the poses", "", None, True) if is_apart else None
    needed = round(scans.offset - _snap(offset), 6)
    cure = f"--clock-offset {scans.topic}={needed!r} or --stamps recorded"
    return Difference(f"{told}: the clocks differ by {abs(offset):,.3f} s", cure, needed, is_apart)


def _measure(rows: NDArray[np.float64], scans: FirstScans) -> float | None:
    """Return by how much the scans' clock is ahead of the poses' [s]; None if nothing was recorded together."""
    recorded, stamps = rows[:, -1], rows[:, 0]
    if not np.isfinite(recorded).all():
        return None
    order = np.argsort(recorded, kind="stable")
    at = np.clip(np.searchsorted(recorded[order], scans.recorded), 0, len(order) - 1)
    near = np.abs(recorded[order][at] - scans.recorded) < _DIFFERENCE
    if not near.any():
        return None
    together = np.interp(scans.recorded, recorded[order], stamps[order])
    return float(np.median((scans.stamps + scans.offset - together)[near]))


def _snap(offset: float) -> float:
    """Return a difference between time scales or zones where it is meant; delays are a part of what was measured."""
    known = np.concatenate([_SCALES, [_ZONE * max(1, round(abs(offset) / _ZONE))]])
    known = known[known <= 14 * 3600]
    nearest = known[np.abs(known - abs(offset)).argmin()] if len(known) else np.inf
    return float(np.sign(offset) * nearest) if abs(nearest - abs(offset)) < _SNAP else offset


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
