"""Which clouds are fused, when, and how many are not: the newest of each topic wins, once its transforms are there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

_RESTART = 1.0  # [s] by which a stamp lies before the last one when a clock or a recording started over


@dataclass
class Counts:
    """How many clouds were received and what became of them."""

    received: int = 0  #: all that arrived
    fused: int = 0  #: into the map
    replaced: int = 0  #: by a newer one that came before they were fused
    repeated: int = 0  #: had the stamp of one that was fused
    late: int = 0  #: fused, though older than the cloud before
    without_transform: int = 0  #: waited for it in vain
    unreadable: int = 0  #: contradicted themselves, or were refused by the map
    jumps: int = 0  #: of a clock, backwards

    def as_dict(self) -> dict[str, int]:
        """Return all counts by name."""
        return {each.name: getattr(self, each.name) for each in fields(self)}


class Waiting(NamedTuple):
    """A cloud that waits for its transforms."""

    topic: str  #: on which it came
    message: Any  #: the cloud
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
    _fused: dict[str, float] = field(default_factory=dict)  # stamp of the last cloud of each topic
    _last: float | None = None  # stamp of the map

    def offer(self, topic: str, message: Any, stamp: float, now: float) -> bool:
        """Take a cloud that arrived; return whether a clock jumped back, so that old transforms are void."""
        self.counts.received += 1
        before = self._fused.get(topic)
        has_jumped = before is not None and stamp < before - _RESTART
        if has_jumped:
            self.counts.jumps += 1
            self._waiting.clear()
            self._fused.clear()
            self._last = None
        elif before is not None and stamp == before:
            self.counts.repeated += 1
            return False
        if topic in self._waiting:
            self.counts.replaced += 1
        self._waiting[topic] = Waiting(topic, message, stamp, now)
        return has_jumped

    def take(self, now: float, is_ready: Callable[[Waiting], bool]) -> tuple[list[Waiting], list[Waiting]]:
        """Return the clouds whose transforms are there, oldest first, and those that waited in vain."""
        ready = sorted((one for one in self._waiting.values() if is_ready(one)), key=lambda one: one.stamp)
        lost = [one for one in self._waiting.values() if one not in ready and now - one.since > self.wait]
        for one in (*ready, *lost):
            del self._waiting[one.topic]
        self.counts.without_transform += len(lost)
        return ready, lost

    def step(self, cloud: Waiting) -> float:
        """Note that a cloud is fused; return the seconds since the one before, 0 for a late one."""
        dt = 0.0 if self._last is None else cloud.stamp - self._last
        self.counts.late += dt < 0
        self.counts.fused += 1
        self._fused[cloud.topic] = cloud.stamp
        self._last = cloud.stamp if self._last is None else max(self._last, cloud.stamp)
        return max(0.0, dt)

    @property
    def stamp(self) -> float | None:
        """Stamp [s] of the map; None before the first cloud."""
        return self._last
