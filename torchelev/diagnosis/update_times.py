"""A warning, once per process, when updates on a CPU become many times slower: threads wait for busy cores."""

from __future__ import annotations

import functools
import math
import os
import time
import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar, cast

import torch

from torchelev.diagnosis.forks import warn_of_fork
from torchelev.ops.waiting import adapted_waits, are_waits_short

WINDOW = 9  # updates per median; more than half of them must be slow, so that compiling a few does not count
PATIENCE = 5  # slow medians in a row before the warning
_SLOW = 5.0  # times the best median

has_warned = False
Update = TypeVar("Update", bound=Callable[..., None])


@dataclass
class _Times:
    """Durations of similar updates."""

    last: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))  #: [s]
    best: float = math.inf  #: [s] lowest median so far
    num_slow: int = 0  #: slow medians in a row


class UpdateTimes:
    """Durations of updates, compared among those of as many threads and about as many points.

    Args:
        clock: returns the time [s]; another one for tests.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.clock = clock
        self._times: dict[tuple[int, int], _Times] = {}

    def note(self, seconds: float, num_points: int) -> None:
        """Take in an update's duration, and warn if updates have become many times slower."""
        kind = num_points.bit_length(), torch.get_num_threads()
        times = self._times.setdefault(kind, _Times())
        times.last.append(seconds)
        if len(times.last) < WINDOW:
            return
        median = sorted(times.last)[WINDOW // 2]
        times.best = min(median, times.best)
        times.num_slow = times.num_slow + 1 if median > _SLOW * times.best else 0
        if times.num_slow >= PATIENCE:
            _warn(median, times.best)


def _warn(median: float, best: float) -> None:
    global has_warned
    if has_warned:
        return
    has_warned = True
    threads = f"call torch.set_num_threads with the number of free cores (now {torch.get_num_threads()})"
    cause, cure = "", f"C{threads[1:]}"
    if not (are_waits_short() or os.environ.get("OMP_WAIT_POLICY", "").strip().upper() == "PASSIVE"):
        cause = ", and OpenMP's threads spin while they wait for each other"
        cure = f"Set OMP_WAIT_POLICY=PASSIVE in the environment before torch is imported, or {threads}"
    warnings.warn(
        f"update: the last {WINDOW} updates took {1e3 * median:.3g} ms (median), {median / best:.0f} times the best, "
        f"{1e3 * best:.3g} ms. The likely cause: other processes are busy on the same cores{cause}. {cure}.",
        RuntimeWarning,
        stacklevel=4,
    )


def timed(update: Update) -> Update:
    """Keep a map's `update` steady on a CPU, see `ops.waiting`, and note in its `update_times` how long it takes.

    A GPU returns early, so nothing is noted there.
    """

    @functools.wraps(update)
    def timed_update(emap: Any, /, *args: Any, **kwargs: Any) -> None:
        if torch.compiler.is_compiling():  # a graph of the caller's own cannot contain a clock
            return update(emap, *args, **kwargs)
        warn_of_fork()
        start = emap.update_times.clock()
        with adapted_waits(emap.device):
            update(emap, *args, **kwargs)
        points: Any = args[0] if args else kwargs["points"]
        if points.device.type == "cpu":
            emap.update_times.note(emap.update_times.clock() - start, points.numel() // 3)

    return cast(Update, timed_update)
