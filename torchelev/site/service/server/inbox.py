"""Messages that wait for the merger, bounded in bytes: what does not fit is dropped, and its robot sends it again."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

MAX_BYTES = 1 << 28


class Entry(NamedTuple):
    """A message, or a question with the function that receives the answer."""

    payload: bytes  #: its bytes
    robot: str | None  #: under whose name the network delivered it; None: not known
    answer: Callable[[bytes], None] | None  #: called with the answer to a question; None: it is no question


class Inbox:
    """A queue that many threads fill and one empties.

    Attributes:
        num_dropped: messages that did not fit.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self.num_dropped, self._max_bytes, self._num_bytes = 0, max_bytes, 0
        self._entries: deque[Entry] = deque()
        self._changed = threading.Condition()

    def put(self, entry: Entry) -> bool:
        """Add an entry, or drop it if there is no room; return whether there was."""
        with self._changed:
            fits = self._num_bytes + len(entry.payload) <= self._max_bytes
            if fits:
                self._entries.append(entry)
                self._num_bytes += len(entry.payload)
                self._changed.notify()
            else:
                self.num_dropped += 1
        return fits

    def take_all(self, timeout: float) -> list[Entry]:
        """Return all entries; wait up to `timeout` [s] for the first one."""
        with self._changed:
            if not self._entries:
                self._changed.wait(timeout)
            entries = list(self._entries)
            self._entries.clear()
            self._num_bytes = 0
        return entries

    def wake(self) -> None:
        """End a wait."""
        with self._changed:
            self._changed.notify_all()
