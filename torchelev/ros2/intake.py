"""Which clouds are fused, when, and how many are not: the newest of each topic wins, once its transforms are there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

_RESTART = 1.0  # [s] by which a stamp lies before the last one when a clock or a recording started over
_SILENCE = 2.0  # [s] without a fused cloud from which a diagnosis says so


@dataclass
class Counts:
    """How many clouds were received and what became of them."""

    received: int = 0  #: clouds that arrived
    fused: int = 0  #: clouds that were added to the map
    replaced: int = 0  #: clouds that a newer one replaced before they were fused
    repeated: int = 0  #: clouds with the stamp of one that was fused already
    late: int = 0  #: fused clouds that were older than the one before
    without_stamp: int = 0  #: clouds whose stamp was 0 or negative
    without_transform: int = 0  #: clouds left out because their transforms did not arrive in time
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


@dataclass
class Intake:
    """Clouds between their arrival and the map. Latency does not grow: each topic has room for one.

    Args:
        wait: [s] that a cloud waits for its transforms.
    """

    wait: float  #: [s] that a cloud waits for its transforms
    counts: Counts = field(default_factory=Counts)  #: of all topics
    _waiting: dict[str, Waiting] = field(default_factory=dict)
    _offered: dict[str, float] = field(default_factory=dict)  # newest stamp of each topic
    _fused: dict[str, float] = field(default_factory=dict)  # stamp of the last cloud of each topic
    _last: float | None = None  # stamp of the map
    _active: float | None = None  # [s] by the node's clock, of the last cloud that was fused

    def offer(self, topic: str, reading: Any, stamp: float, now: float) -> bool:
        """Take a cloud that arrived; return whether a clock jumped back, so that old transforms are void."""
        self.counts.received += 1
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
        self.counts.replaced += topic in self._waiting
        self._waiting[topic] = Waiting(topic, reading, stamp, now)
        return has_jumped

    def start_over(self) -> None:
        """Forget all stamps, as a clock jumped."""
        self.counts.jumps += 1
        self.counts.replaced += len(self._waiting)
        for stamps in (self._waiting, self._offered, self._fused):
            stamps.clear()
        self._last = self._active = None

    def take(self, now: float, is_ready: Callable[[Waiting], bool]) -> tuple[list[Waiting], list[Waiting]]:
        """Return the clouds whose transforms are there, oldest first, and those that waited in vain."""
        ready = sorted((one for one in self._waiting.values() if is_ready(one)), key=lambda one: one.stamp)
        topics = {one.topic for one in ready}
        lost = [one for one in self._waiting.values() if one.topic not in topics and now - one.since > self.wait]
        for one in (*ready, *lost):
            del self._waiting[one.topic]
        self.counts.without_transform += len(lost)
        return ready, lost

    def elapsed(self, cloud: Waiting) -> float:
        """Return the seconds from the last fused cloud to this one, 0 for a late one."""
        return 0.0 if self._last is None else max(0.0, cloud.stamp - self._last)

    def note_fused(self, cloud: Waiting, now: float) -> None:
        """Note that a cloud is in the map."""
        self.counts.fused += 1
        self.counts.late += self._last is not None and cloud.stamp < self._last
        self._fused[cloud.topic] = cloud.stamp
        self._last = cloud.stamp if self._last is None else max(self._last, cloud.stamp)
        self._active = now

    @property
    def stamp(self) -> float | None:
        """Stamp [s] of the map; None before the first cloud."""
        return self._last

    def findings(self, now: float) -> list[str]:
        """Return what is wrong with the flow of clouds, in a sentence."""
        counts = self.counts
        if self._active is not None and now - self._active < _SILENCE:
            return []
        if not counts.received:
            return ["clouds: none was received: check the parameter clouds, and reliable against the publisher's QoS"]
        for_long = "none was fused yet" if self._active is None else f"none was fused for {now - self._active:.0f} s"
        losses = ", ".join(f"{number} {name}" for name, number in counts.as_dict().items() if number)
        return [f"clouds: {for_long} ({losses}): check tf, stamps and the sensor"]
