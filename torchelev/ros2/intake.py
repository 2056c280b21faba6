"""Which clouds are fused, when, and how many are not: the newest of each topic wins, once its transforms are there."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

_RESTART = 1.0  # [s] by which a stamp lies before the last one when a clock or a recording started over
_MOST = 32  # clouds of a topic that wait
_SILENCE = 2.0  # [s] without a fused cloud from which a diagnosis says so


@dataclass
class Counts:
    """How many clouds were received and what became of them."""

    received: int = 0  #: clouds that arrived
    fused: int = 0  #: clouds that were added to the map
    replaced: int = 0  #: clouds left out because a newer one was fused
    repeated: int = 0  #: clouds with the stamp of one that was fused already
    late: int = 0  #: fused clouds that were older than the one before
    without_stamp: int = 0  #: clouds whose stamp was 0 or negative
    without_transform: int = 0  #: clouds left out because their transforms, or their CameraInfo, did not arrive in time
    unreadable: int = 0  #: clouds that could not be read, or that the map refused
    jumps: int = 0  #: times that a clock jumped backwards

    def as_dict(self) -> dict[str, int]:
        """Return all counts by name."""
        return {each.name: getattr(self, each.name) for each in fields(self)}


class Waiting(NamedTuple):
    """A cloud that waits for its transforms."""

    topic: str  #: topic of the cloud
    reading: Any  #: the cloud, see `sensors.Reading`
    stamp: float  #: [s] of the message
    since: float  #: [s] by the node's own clock


class Intake:
    """Clouds between their arrival and the map: the newest of each topic whose transforms are there.

    Latency does not grow: what is older than a cloud that is fused is left out, and so is what waits too long.

    Args:
        topics: of all sensors.
        wait: [s] that a cloud waits for its transforms.
    """

    def __init__(self, topics: Iterable[str], wait: float) -> None:
        self.wait, self.counts = wait, Counts()
        self._waiting: dict[str, deque[Waiting]] = {topic: deque() for topic in topics}
        self._received: set[str] = set()
        self._active: dict[str, float] = {}  # [s] by the node's clock, of the last cloud of each topic that was fused
        self._offered: dict[str, float] = {}  # newest stamp of each topic
        self._fused: dict[str, float] = {}  # stamp of the last cloud of each topic
        self._last: float | None = None  # stamp of the map

    def offer(self, topic: str, reading: Any, stamp: float, now: float) -> bool:
        """Take a cloud that arrived; return whether a clock jumped back, so that old transforms are void."""
        self.counts.received += 1
        self._received.add(topic)
        if stamp <= 0:
            self.counts.without_stamp += 1
            return False
        has_jumped = stamp < self._offered.get(topic, stamp) - _RESTART
        if has_jumped:
            self.start_over()
        elif stamp == self._fused.get(topic):
            self.counts.repeated += 1
            return False
        self._offered[topic] = max(stamp, self._offered.get(topic, stamp))
        waiting = self._waiting[topic]
        if len(waiting) == _MOST:
            waiting.popleft()
            self.counts.replaced += 1
        waiting.append(Waiting(topic, reading, stamp, now))
        return has_jumped

    def start_over(self) -> None:
        """Forget all stamps, as a clock jumped."""
        self.counts.jumps += 1
        for waiting in self._waiting.values():
            self.counts.replaced += len(waiting)
            waiting.clear()
        for stamps in (self._offered, self._fused, self._active):
            stamps.clear()
        self._last = None

    @property
    def is_waiting(self) -> bool:
        """Whether a cloud waits for its transforms."""
        return any(self._waiting.values())

    def take(self, now: float, is_ready: Callable[[Waiting], bool]) -> tuple[list[Waiting], list[Waiting]]:
        """Return the newest cloud of each topic that is ready, oldest first, and those that waited too long."""
        ready, lost = [], []
        for waiting in self._waiting.values():
            newest = None
            while waiting and is_ready(waiting[0]):  # transforms arrive in the order of their stamps
                self.counts.replaced += newest is not None
                newest = waiting.popleft()
            if newest is not None:
                ready.append(newest)
            while waiting and now - waiting[0].since > self.wait:
                lost.append(waiting.popleft())
        self.counts.without_transform += len(lost)
        return sorted(ready, key=lambda one: one.stamp), lost

    def elapsed(self, cloud: Waiting) -> float:
        """Return the seconds from the last fused cloud to this one, 0 for a late one."""
        return 0.0 if self._last is None else max(0.0, cloud.stamp - self._last)

    def note_fused(self, cloud: Waiting, now: float) -> None:
        """Note that a cloud is in the map."""
        self.counts.fused += 1
        self.counts.late += self._last is not None and cloud.stamp < self._last
        self._fused[cloud.topic] = cloud.stamp
        self._last = cloud.stamp if self._last is None else max(self._last, cloud.stamp)
        self._active[cloud.topic] = now

    @property
    def stamp(self) -> float | None:
        """Stamp [s] of the map; None before the first cloud."""
        return self._last

    def findings(self, now: float) -> list[str]:
        """Return what is wrong with the flow of each topic's clouds, in a sentence."""
        return [text for topic in self._waiting if (text := self._finding(topic, now))]

    def _finding(self, topic: str, now: float) -> str:
        if topic not in self._received:
            return f"{topic}: nothing was received: check its name, and the parameter reliable against its QoS"
        since = now - self._active.get(topic, -math.inf)
        if since < _SILENCE:
            return ""
        for_long = "nothing was fused yet" if math.isinf(since) else f"nothing was fused for {since:.0f} s"
        return f"{topic}: {for_long}: check tf, stamps and the sensor; the node's log says more"
