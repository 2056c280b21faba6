"""Find clocks that differ or were never set, before mapping, from stamps and the times of recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.bags.poses.transforms import TransformTree
from torchelev.io.errors import RecordingError

_DIFFERENCE = 2.0  # [s] between two clocks; delays of sensors and of odometry are shorter
_LATEST = 10.0  # [s] by which a mapper that is slower than its sensors may publish poses late
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
    """The clock of the moving frames between the map and some frames.

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

    def has_started(self, recorded: float) -> bool:
        """Return whether poses were recorded before a time [s]."""
        return len(self._recorded) > 0 and bool(self._recorded[0] <= recorded)

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
        cure = f"--clock-offset {scans.topic}={needed!r}"
        if 0 < offset <= _LATEST and not is_apart:
            late = f"{ranges}: the poses arrive {offset:,.3f} s late, which does no harm, or the clocks differ"
            return Difference(late, f"{cure} if they differ", None, False)
        difference = f"{ranges}: the clocks differ by {abs(offset):,.3f} s"
        return Difference(difference, f"{cure} or --stamps recorded", needed, is_apart)


class SettingWatch:
    """Notices scans whose clock is set during a recording and then differs from that of the poses.

    Args:
        clock: of the poses.

    Attributes:
        notes: on topics that began before the poses, and whose stamps are ahead of theirs.
    """

    def __init__(self, clock: PoseClock) -> None:
        self._clock = clock
        self._last: dict[str, float] = {}  # [s] by which the stamps of a topic were ahead of those of the poses
        self._early: set[str] = set()  # topics that began before the poses, so that `compare` could not measure them
        self.notes: list[str] = []

    def is_set(self, topic: str, stamp: float, recorded: float) -> bool:
        """Return whether a scan has a stamp of another clock; poses may arrive with a growing delay."""
        ahead = self._clock.measure(stamp, recorded) if self._clock.has_started(recorded) else None
        if ahead is None:
            self._early |= {topic} - self._last.keys()
            return False
        last = self._last.get(topic, min(max(ahead, 0.0), _LATEST))
        if abs(ahead) > _DIFFERENCE and abs(ahead - last) > _DIFFERENCE:
            return True
        if ahead > _DIFFERENCE and topic in self._early:
            self._early.discard(topic)
            self.notes.append(
                f"stamps of {topic} are {ahead:,.3f} s ahead of those of the poses: the poses arrive late, which does "
                f"no harm, or the clocks differ; give --clock-offset {topic}={round(-_snap(ahead), 6)!r} if they differ"
            )
        self._last[topic] = ahead
        return False


def _snap(offset: float) -> float:
    """Return the difference of time scales or zones near an offset, which includes delays; else the offset."""
    known = np.concatenate([_SCALES, [_ZONE * max(1, round(abs(offset) / _ZONE))]])
    known = known[known <= 14 * 3600]
    nearest = known[np.abs(known - abs(offset)).argmin()] if len(known) else np.inf
    return float(np.sign(offset) * nearest) if abs(nearest - abs(offset)) < _SNAP else offset
