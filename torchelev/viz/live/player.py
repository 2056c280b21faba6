"""Play, pause, step and scrub a recording while it is mapped."""

from __future__ import annotations

import bisect
import threading
import time
from typing import Any

from numpy.typing import NDArray

from torchelev.viz.live.page import Page
from torchelev.viz.live.snapshot import Snapshot

SPEEDS = {"0.25x": 0.25, "0.5x": 0.5, "1x": 1.0, "2x": 2.0, "4x": 4.0, "max": 1e6}
BUTTONS = ("play", "pause", "back", "step")
_MAX_BYTES = 400_000_000  # of the snapshots that are kept for going back
_MAX_RATE = 15.0  # [Hz] of pictures
_MAX_DELAY = 0.5  # [s] behind the recording's time


class History:
    """Snapshots for going back, evenly spaced in the recording; when memory is short, every second one is dropped.

    Args:
        max_bytes: memory of the snapshots.
    """

    def __init__(self, max_bytes: int = _MAX_BYTES) -> None:
        self._max_bytes, self._num_bytes, self._spacing = max_bytes, 0, 1
        self._numbers: list[int] = []
        self._snapshots: list[Snapshot] = []

    def add(self, number: int, snapshot: Snapshot) -> None:
        """Keep the snapshot of a scan, if the scan falls on the spacing."""
        if number % self._spacing:
            return
        self._numbers.append(number)
        self._snapshots.append(snapshot)
        self._num_bytes += snapshot.nbytes
        while self._num_bytes > self._max_bytes and len(self._numbers) > 2:
            self._spacing *= 2
            kept = [k for k, n in enumerate(self._numbers) if n % self._spacing == 0]
            self._numbers = [self._numbers[k] for k in kept]
            self._snapshots = [self._snapshots[k] for k in kept]
            self._num_bytes = sum(snapshot.nbytes for snapshot in self._snapshots)

    def at(self, number: int) -> Snapshot:
        """Return the last snapshot that is kept up to a scan."""
        return self._snapshots[max(0, bisect.bisect_right(self._numbers, number) - 1)]


class Player:
    """Shows a recording on a page at its own speed; the caller fuses the scans, and calls `show` after each.

    Args:
        page: to draw on.
        num_scans: of the recording.
        is_playing: False waits at the first scan.
    """

    def __init__(self, page: Page, num_scans: int, is_playing: bool = True) -> None:
        self._page, self._num_scans, self._is_playing = page, num_scans, is_playing
        self._history = History()
        self._path: list[NDArray] = []  # of the base, a position for each scan
        self._latest: Snapshot | None = None
        self._now = self._shown = -1  # number of the last scan, and of the one on the page
        self._wanted: int | None = None  # the scan that the user asked for
        self._is_over = False  # all scans are mapped
        self._start: tuple[float, float] | None = None  # wall time and recording's time [s] since it plays
        self._drawn_at = 0.0
        self._changed = threading.Condition()
        self._add_controls()

    @property
    def num_shown(self) -> int:
        """The number of scans that `show` was called for."""
        return self._now + 1

    def _add_controls(self) -> None:
        gui = self._page.server.gui
        with gui.add_folder("recording", order=-1.0):
            self._slider: Any = gui.add_slider("scan", 1, max(self._num_scans, 2), 1, 1)
            self._buttons: Any = gui.add_button_group("playback", BUTTONS)
            self._speed: Any = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1x")
        self._slider.on_update(self._scrub)
        self._buttons.on_click(lambda event: self._press(event.target.value))
        self._speed.on_update(lambda _: self._restart_clock())

    def _scrub(self, event: Any) -> None:
        if event.client is not None:  # else it was this player that moved the slider
            self._ask_for(int(event.target.value) - 1)

    def _press(self, button: str) -> None:
        """Perform a button's action."""
        if button == "play":
            with self._changed:
                self._is_playing, self._wanted = True, None
                if not self._is_over and self._shown < self._now:
                    self._wanted = self._now  # continue the mapping
                elif self._is_over and self._shown >= self._now:
                    self._shown = -1  # play again
                self._restart_clock()
                self._changed.notify_all()
            return
        self._is_playing = False
        self._ask_for({"back": max(0, self._shown - 1), "step": self._shown + 1}.get(button, self._shown))

    def _ask_for(self, number: int) -> None:
        with self._changed:
            self._wanted = min(number, self._num_scans - 1)
            self._is_playing = self._is_playing and number > self._now
            self._restart_clock()
            self._changed.notify_all()

    def _restart_clock(self) -> None:
        self._start = None

    def show(self, snapshot: Snapshot) -> None:
        """Show the next scan, and return when the one after it is wanted: later if paused, at once if scrubbed to.

        Args:
            snapshot: after the scan; its time [s] says when it is due.
        """
        self._now += 1
        self._latest = snapshot
        base = snapshot.T_map_base
        self._path += [] if base is None else [base[:3, 3]]
        self._history.add(self._now, snapshot)
        if self._wanted is None:
            self._wait_until_due(snapshot.time)
        if self._wanted is None or self._wanted <= self._now:
            self._wanted = None
            self._draw(self._now, snapshot)
        while not self._wants_next():
            self._show_earlier()

    def hold(self) -> None:
        """Keep the page open after the last scan, for playing again, until Ctrl-C raises."""
        if self._latest is not None:
            self._draw(self._now, self._latest)
        self._is_playing, self._is_over = False, True
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._wanted is not None or self._is_replaying, timeout=0.5)
            self._show_earlier()
            if self._is_replaying:
                number = self._shown + 1
                snapshot = self._history.at(number)
                self._wait_until_due(snapshot.time)
                if self._is_replaying:
                    self._draw(number, snapshot)

    @property
    def _is_replaying(self) -> bool:
        return self._is_over and self._is_playing and self._wanted is None and self._shown < self._now

    def _wait_until_due(self, time_now: float) -> None:
        """Wait until the wall clock reaches a time of the recording [s], or the user asks for another scan."""
        wall, speed = time.monotonic(), SPEEDS[self._speed.value]
        if self._start is None or wall - self._start[0] > (time_now - self._start[1]) / speed + _MAX_DELAY:
            self._start = wall, time_now  # mapping cannot keep up: continue from here
        left = self._start[0] + (time_now - self._start[1]) / speed - wall
        with self._changed:
            self._changed.wait_for(lambda: self._wanted is not None or not self._is_playing, timeout=max(left, 0.0))

    def _wants_next(self) -> bool:
        """Wait for a while; return whether the next scan is wanted."""
        with self._changed:
            if self._wanted is None and not (self._is_playing and self._shown == self._now):
                self._changed.wait(0.5)
            if self._wanted is None:
                return self._is_playing and self._shown == self._now
            return self._wanted > self._now

    def _show_earlier(self) -> None:
        """Show the scan that the user asked for, if it is fused already."""
        with self._changed:
            wanted = self._wanted
            if wanted is None or (wanted > self._now and self._now < self._num_scans - 1):
                return
            self._wanted = None
        if wanted >= self._now and self._latest is not None:
            self._draw(self._now, self._latest)
        else:
            self._draw(wanted, self._history.at(wanted))

    def _draw(self, number: int, snapshot: Snapshot) -> None:
        """Draw a snapshot; while playing at most `_MAX_RATE` of them."""
        self._shown = number
        if self._is_playing and not self._is_due(number):
            return
        self._drawn_at = time.monotonic()
        self._slider.value = number + 1
        status = f"Scan {number + 1} of {self._num_scans}, {snapshot.time:.1f} s"
        self._page.draw(snapshot, status, self._path[: number + 1])

    def _is_due(self, number: int) -> bool:
        """Whether a picture may be drawn while playing: at most `_MAX_RATE`, and always the last one."""
        return number == self._num_scans - 1 or time.monotonic() - self._drawn_at >= 1 / _MAX_RATE
