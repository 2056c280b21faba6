"""The live view of a map in your own loop, without slowing it down."""

from __future__ import annotations

import os
import sys
import threading
import time
from types import TracebackType
from typing import TYPE_CHECKING, Any

from torchelev.errors import require
from torchelev.viz.live.page import Page
from torchelev.viz.live.snapshot import Snapshot, take_snapshot

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap

_WHOLE_COST = 4.0  # cost of a picture for a loop on all cores, by its CPU time: benchmarks.speed.live_view
_USED_IDLENESS = 0.5  # share of a loop's spare time that drawing may take


class Load:
    """The load of the calling thread and of all cores."""

    def __init__(self) -> None:
        self._num_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self._before = self._now()

    def _now(self) -> tuple[float, float, float]:
        return time.perf_counter(), time.thread_time(), time.process_time()

    def measure_idleness(self) -> float:
        """Return the idle share of this thread, and of the cores, since the previous call."""
        now = self._now()
        wall, thread, process = (b - a for a, b in zip(self._before, now, strict=True))
        self._before = now
        return 1 - min(1.0, max(thread, process / self._num_cores) / max(wall, 1e-6))


class LiveView:
    """A page that shows a map while it is used; also a context, which closes the page.

    ```python
    view = LiveView(emap)                                  # prints the page's address
    while True:
        emap.update(points, T_map_sensor, T_map_base, dt)
        view.show(T_map_base, T_map_sensor, points)        # returns at once
    ```

    Args:
        emap: the map.
        host: "127.0.0.1" lets only this machine connect, "0.0.0.0" every machine that reaches it.
        port: of the page. If it is taken, the next free one is used.
        max_share: share of a busy loop's time that the view may take; pictures beyond it are dropped. A loop that
            waits, such as one at 10 Hz, is shown more often, in the time that it does not need.
        max_rate: [Hz] of pictures at most.

    Raises:
        ModuleNotFoundError: viser is missing.
        ValueError: a number is out of range.
    """

    def __init__(
        self,
        emap: ElevationMap,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        max_share: float = 0.05,
        max_rate: float = 15.0,
    ) -> None:
        require(0 < max_share <= 1, "max_share", "must lie in (0, 1]", max_share, "use 0.05")
        require(max_rate > 0, "max_rate", "must be positive", max_rate, "use 15")
        self._emap, self._max_share, self._max_rate = emap, max_share, max_rate
        self.page = Page("torchelev", emap.layers, emap.num_envs, host, port, emap.cfg.channels)
        self._start = self._due = time.perf_counter()
        self._load = Load()
        self._arguments: tuple[Any, ...] = (None,) * 5  # of the last `show`
        self._drawing = 0.0  # [s] of the CPU for the last picture
        self._next: Snapshot | None = None
        self._wake, self._stopped = threading.Condition(), False
        self.num_drawn = 0
        self._thread = threading.Thread(target=self._draw, name="live view", daemon=True)
        self._thread.start()
        print(f"torchelev: the live view is at {self.page.url}", flush=True)

    def show(
        self,
        T_map_base: Any = None,
        T_map_sensor: Any = None,
        points: Any = None,
        *,
        scan: Any = None,
        plan: Any = None,
    ) -> bool:
        """Show the present map, unless pictures have used their share of the time.

        Args:
            T_map_base: as for `take_snapshot`, like all others.
            T_map_sensor: poses of the sensors.
            points: the last cloud, sensor frame.
            scan: points that a policy reads, map frame.
            plan: planned path, map frame.

        Returns:
            Whether it will be shown; never once the page is closed.
        """
        if self._stopped:
            return False
        start = time.perf_counter()
        self._arguments = (T_map_base, T_map_sensor, points, scan, plan)
        if start < self._due or self._next is not None:
            return False
        snapshot = self._take(start - self._start)
        with self._wake:
            self._next = snapshot
            self._wake.notify()
        taken = time.perf_counter() - start
        share = self._max_share + (1 - self._max_share) * _USED_IDLENESS * self._load.measure_idleness()
        self._due = start + max(1 / self._max_rate, (taken + _WHOLE_COST * self._drawing) / share)
        return True

    def _take(self, seconds: float) -> Snapshot:
        """Copy the environment that the page asks for, with the arguments of the last `show`."""
        T_map_base, T_map_sensor, points, scan, plan = self._arguments
        own: dict[str, Any] = {"env": self.page.env, "layers": self._own_layers(), "time": seconds}
        return take_snapshot(self._emap, T_map_base, T_map_sensor, points, scan=scan, plan=plan, **own)

    def _own_layers(self) -> tuple[str, ...]:
        """The layer of a filter, or those of a channel, that colour the map, if they do; others are not computed."""
        channel = self._emap.cfg.channels.get(self.page.layer)
        if channel is not None:
            return channel.components(self.page.layer)
        return (self.page.layer,) if self.page.layer in self._emap.layers else ()

    def _draw(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._next is not None or self._stopped)
                snapshot = self._next
            if self._stopped or snapshot is None:
                return
            start = time.thread_time()
            self.page.draw(snapshot, f"{snapshot.time:.1f} s")
            if self.num_drawn:  # the first picture also loads packages
                self._drawing = time.thread_time() - start
            self.num_drawn += 1
            self._next = None

    def wait(self) -> None:
        """Keep the page open after the loop, until Ctrl-C. Another robot can still be chosen."""
        last = self.page.last_time
        self.page.on_change = lambda: self.page.draw(self._take(last))
        try:
            self.page.wait()
        except KeyboardInterrupt:
            self.close()

    def close(self) -> None:
        """Close the page."""
        with self._wake:
            self._stopped = True
            self._wake.notify()
        self._thread.join()
        self.page.stop()

    def __enter__(self) -> LiveView:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_view(emap: ElevationMap, T_map_base: Any = None, *, block: bool | None = None, **options: Any) -> LiveView:
    """Open a view of a map as it is; see `ElevationMap.show`."""
    view = LiveView(emap, **options)
    try:
        view.show(T_map_base)
    except BaseException:
        view.close()
        raise
    is_interactive = hasattr(sys, "ps1") or bool(sys.flags.interactive) or "ipykernel" in sys.modules
    if block or (block is None and not is_interactive):
        view.wait()
    return view
