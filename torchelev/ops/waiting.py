"""How long OpenMP's threads spin while they wait for each other: as usual on free cores, briefly beside a process.

Spinning is fastest while every thread has a core. Once another process wants one, threads that spin keep the cores from
the very threads that they wait for: measured by `benchmarks.speed.loop`, some updates take more than ten times as long.
"""

from __future__ import annotations

import contextlib
import functools
import os
import threading
import time
from collections.abc import Callable, Iterator

import torch

SETTINGS = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")  # the environment's; where one is set, waits are left alone
BUSY, FREE = 6, 10  # samples in a row before waits become short, and updates in a row before they become long
_PAUSE = 5e-4  # [s] between samples; what the system itself does is mostly over by the last one
_SPIN = 0.02  # [s] longest spinning after an update, until less has been seen
_TAIL = 0.002  # [s] how much earlier than an update its last team may end
_PARALLEL = 2**16  # elements; torch shares an operation on so many between all threads


class SpareTeam:
    """A second team of OpenMP threads, which sleeps. While it is there, all waits of the process are short.

    GNU's OpenMP lets a waiting thread spin 300,000 times, but 100 times while its threads outnumber the cores. A team
    belongs to a Python thread, and ends with it.
    """

    def __init__(self) -> None:
        self._leave = threading.Event()

    def start(self) -> None:
        """Start the team, and return when it is there."""
        ready, self._leave = threading.Event(), threading.Event()
        threading.Thread(target=self._run, args=(ready, self._leave), name="torchelev-waits", daemon=True).start()
        ready.wait()

    def end(self) -> None:
        """End the team."""
        self._leave.set()

    @staticmethod
    def _run(ready: threading.Event, leave: threading.Event) -> None:
        num_threads = torch.get_num_threads()
        torch.set_num_threads(max(2, num_cores()))
        torch.ones(_PARALLEL, device="cpu")
        torch.set_num_threads(num_threads)  # also what threads get that start later
        ready.set()
        leave.wait()


class Waits:
    """Makes waits short while other processes want the cores.

    Args:
        count_running: returns how many threads of all processes run or wait for a core, the caller included.
        count_own: returns how many of these belong to this process; takes longer.
        team: makes waits short.
        clock: returns the time [s].
        sleep: sleeps for a time [s].
    """

    def __init__(
        self,
        count_running: Callable[[], int],
        count_own: Callable[[], int],
        team: SpareTeam,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.count_running = count_running
        self.count_own = count_own
        self.team = team
        self.clock = clock
        self.sleep = sleep
        self.short = False
        self._num_free = 0  # updates in a row
        self._spin = _SPIN
        self._spinning_from = float("-inf")  # [s] end of the last update whose threads spun then
        self._lock = threading.Lock()  # updates of several maps may run at the same time

    @contextlib.contextmanager
    def adapted(self, num_threads: int) -> Iterator[None]:
        """Choose before an update of so many threads how long they wait for each other."""
        with self._lock:
            if self.short:
                self._lengthen_if_free(num_threads)
            else:
                running = self.count_running()
                self._shorten_if_busy(num_threads, running, self._expect_own(num_threads, running))
        yield
        is_spinning = not self.short and self.count_running() >= num_threads
        self._spinning_from = self.clock() if is_spinning else float("-inf")

    def _expect_own(self, num_threads: int, running: int) -> int:
        """Return how many threads of this process may be running before an update: those of the last one may spin."""
        since = self.clock() - self._spinning_from
        if running == 1:
            self._spin = min(self._spin, since)
        return num_threads if since < self._spin + _TAIL else 1

    def _shorten_if_busy(self, num_threads: int, running: int, own: int) -> None:
        spare = num_cores() - num_threads
        for k in range(BUSY):
            # Threads of this process may also spin after an operation that was no update.
            if running - own <= spare or running - self.count_own() <= spare:
                return
            if k < BUSY - 1:
                self.sleep(_PAUSE)
                running = self.count_running()
        self.team.start()
        self.short, self._num_free = True, 0

    def _lengthen_if_free(self, num_threads: int) -> None:
        is_free = self.count_running() - 1 + num_threads <= num_cores()
        self._num_free = self._num_free + 1 if is_free else 0
        if self._num_free == FREE:
            self.team.end()
            self.short = False


@functools.cache  # asking the system takes as long as all else that is done here
def num_cores() -> int:
    """Return the number of the machine's cores."""
    return os.cpu_count() or 1


class RunningThreads:
    """Counts the threads of all processes that run or wait for a core, as Linux reports it."""

    def __init__(self) -> None:
        self._file = os.open("/proc/loadavg", os.O_RDONLY | os.O_CLOEXEC)  # stays open: opening takes most of the time

    def __call__(self) -> int:
        """Return their number."""
        return int(os.pread(self._file, 64, 0).split()[3].partition(b"/")[0])


def count_own_running() -> int:
    """Count the threads of this process that run or wait for a core, as Linux reports it."""
    return sum(map(_is_running, os.listdir("/proc/self/task")))


def _is_running(thread: str) -> bool:
    try:
        file = os.open(f"/proc/self/task/{thread}/stat", os.O_RDONLY | os.O_CLOEXEC)
    except OSError:  # it has ended
        return False
    try:
        return os.read(file, 512).rpartition(b")")[2].split()[0] == b"R"
    except (OSError, IndexError):
        return False
    finally:
        os.close(file)


@functools.cache
def process_waits() -> Waits | None:
    """Return what adapts the waits of this process, or None where the user has set them or the system is not Linux."""
    if any(name in os.environ for name in SETTINGS):
        return None
    try:
        return Waits(RunningThreads(), count_own_running, SpareTeam())
    except OSError:
        return None


def adapted_waits(device: torch.device) -> contextlib.AbstractContextManager[None]:
    """Run an update in this: its threads wait briefly for each other while other processes want the cores."""
    num_threads = torch.get_num_threads()
    if device.type != "cpu" or num_threads == 1 or (waits := process_waits()) is None:
        return contextlib.nullcontext()
    return waits.adapted(num_threads)


def are_waits_short() -> bool:
    """Return whether the process has made its waits short."""
    waits = process_waits()
    return waits is not None and waits.short
