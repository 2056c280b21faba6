"""Messages of several sensors in the order of their stamps: they are recorded in the order in which they arrive."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence

from torchelev.io.bags.bag import Message
from torchelev.io.bags.scans import stamp_of

_MAX_WAIT = 1.0  # [s] delay of a message behind other sensors' stamps, at most
_MAX_HELD = 32  # messages in memory


def _stamp_of(message: Message) -> float:
    return stamp_of(message.data.header)


def order_by_stamp(
    messages: Iterable[Message], topics: Sequence[str], time_of: Callable[[Message], float] = _stamp_of
) -> Iterator[Message]:
    """Yield messages with headers by their stamps, those of one topic in the order in which they come.

    A message waits until each topic has one of the same time or later, for at most one second of stamps and 32
    messages: a sensor that falls silent holds up the others no longer.

    Args:
        messages: in the order of their recording.
        topics: of all messages.
        time_of: returns the time [s] of a message.
    """
    latest = dict.fromkeys(topics, -float("inf"))
    held: list[tuple[float, int, Message]] = []
    for number, message in enumerate(messages):
        stamp = time_of(message)
        latest[message.topic] = stamp
        heapq.heappush(held, (stamp, number, message))
        complete = max(min(latest.values()), max(latest.values()) - _MAX_WAIT)
        while held and (held[0][0] <= complete or len(held) > _MAX_HELD):
            yield heapq.heappop(held)[2]
    while held:
        yield heapq.heappop(held)[2]
