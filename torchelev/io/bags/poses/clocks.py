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
_DIFFERENCE = 2.0  # [s] between two clocks; delays of sensors and of odometry are shorter
_TOGETHER = 1.0  # [s] between two recordings at one time
_SOME = 20  # poses of a frame whose stamps are looked at
_SLOWEST = 0.01  # of the time of stamps; bags that were recorded faster have no times of recording
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


class PoseClock:
    """The clock of the moving frames on the ways from the map to some frames.

    Args:
        tree: all transforms.
        map_frame: the map's frame.
        ends: frames whose poses in the map are needed.

    Attributes:
        notes: on frames whose clocks differ.
    """

    def __init__(self, tree: TransformTree, map_frame: str, ends: Sequence[str]) -> None:
        moving = dict.fromkeys(frame for end in ends for frame in tree.moving_between(map_frame, end))
        rows = {frame: tree.recorded_rows(frame) for frame in moving}
        rows = {frame: row for frame, row in rows.items() if len(row) > 1}
        self._names = ", ".join(rows)
        self._ranges = [(float(row[:, 0].min()), float(row[:, 0].max())) for row in rows.values()]
        self._is_unset = any(not row[:, 0].any() for row in rows.values())
        first = next(iter(rows.values()), np.zeros((0, 9)))
        order = np.argsort(first[:, -1], kind="stable")
        self._recorded, self._stamps = first[order, -1], first[order, 0]
        if len(first) and not np.ptp(self._recorded) >= _SLOWEST * np.ptp(self._stamps):
            self._recorded = self._stamps = np.zeros(0)
        self.notes = [note for note in map(self._compare_frame, rows, rows.values()) if note]

    def _compare_frame(self, frame: str, rows: NDArray[np.float64]) -> str:
        """Return a sentence if the poses of a frame are stamped by another clock; "" if not."""
        some = rows[np.linspace(0, len(rows) - 1, _SOME).astype(int)]
        found = [ahead for ahead in (self.measure(row[0], row[-1]) for row in some) if ahead is not None]
        if not found or abs(offset := float(np.median(found))) < _DIFFERENCE:
            return ""
        return (
            f"stamps of {frame} are {rows[:, 0].min():,.3f} .. {rows[:, 0].max():,.3f} s, {abs(offset):,.3f} s "
            f"{'ahead of' if offset > 0 else 'behind'} the other poses: their clocks differ; give --stamps recorded"
        )

    def measure(self, stamp: float, recorded: float) -> float | None:
        """Return by how much a stamp is ahead of this clock [s]; None if no pose was recorded at its time."""
        at = int(np.searchsorted(self._recorded, recorded))
        near = self._recorded[max(at - 1, 0) : at + 1]
        if not len(near) or np.abs(near - recorded).min() > _TOGETHER:
            return None
        return stamp - float(np.interp(recorded, near, self._stamps[max(at - 1, 0) : at + 1]))

    def differs(self, stamp: float, recorded: float) -> bool:
        """Return whether a stamp [s] is certainly of another clock."""
        ahead = self.measure(stamp, recorded)
        return ahead is not None and abs(ahead) > _DIFFERENCE

    def compare(self, scans: FirstScans) -> Difference | None:
        """Compare the stamps of a topic's scans with those of the poses.

        Stamps that were recorded at the same time differ by a clock's offset and short delays. If nothing was recorded
        at the same time, the ranges of the stamps are compared.
        """
        if not self._ranges:
            return None
        low, high = max(first for first, _ in self._ranges), min(last for _, last in self._ranges)
        first = float(scans.stamps.min()) + scans.offset
        last = first + max(0.0, scans.end - float(scans.recorded[0]))
        ranges = (
            f"stamps of {scans.topic} are {first:,.3f} .. {last:,.3f} s, those of {self._names} {low:,.3f} .. "
            f"{high:,.3f} s"
        )
        is_apart = last < low - _TOGETHER or first > high + _TOGETHER
        if is_apart and (self._is_unset or not scans.stamps.any()):
            unset = "the poses" if self._is_unset else scans.topic
            return Difference(f"{ranges}: those of {unset} were never filled in", "--stamps recorded", None, True)
        pairs = zip(scans.stamps + scans.offset, scans.recorded, strict=True)
        found = [ahead for ahead in (self.measure(*pair) for pair in pairs) if ahead is not None]
        offset = float(np.median(found)) if found else None
        if offset is None or abs(offset) < _DIFFERENCE:
            return Difference(f"{ranges}: no scan lies within the poses", "", None, True) if is_apart else None
        needed = round(scans.offset - _snap(offset), 6)
        cure = f"--clock-offset {scans.topic}={needed!r} or --stamps recorded"
        return Difference(f"{ranges}: the clocks differ by {abs(offset):,.3f} s", cure, needed, is_apart)


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
