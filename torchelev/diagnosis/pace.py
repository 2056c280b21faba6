"""Says once when updates on a CPU take many times as long as they did: threads that wait for busy cores."""

from __future__ import annotations

import functools
import math
import statistics
import time
import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar, cast

import torch

RECENT = 9  # updates whose median counts; less than half of them may compile
SLOWER = 5.0  # times the best median
IN_A_ROW = 5  # updates with such a median

_warned = False
Update = TypeVar("Update", bound=Callable[..., None])


@dataclass
class Recent:
    """Updates of one kind."""

    times: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))  #: [s]
    best: float = math.inf  #: [s] the lowest median so far
    slow: int = 0  #: how many of the last updates in a row had a median many times that


class Pace:
    """How long updates take, apart for each order of the number of points and each number of threads."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.clock = clock
        self.recent: dict[tuple[int, int], Recent] = {}

    def note(self, seconds: float, num_points: int) -> None:
        """Take in one update; warn, once in a process, if updates have become many times slower."""
        kind = num_points.bit_length(), torch.get_num_threads()
        recent = self.recent.setdefault(kind, Recent())
        recent.times.append(seconds)
        if len(recent.times) < RECENT:
            return
        median = statistics.median(recent.times)
        recent.best = min(median, recent.best)
        recent.slow = recent.slow + 1 if median > SLOWER * recent.best else 0
        if recent.slow >= IN_A_ROW:
            _warn(median, recent.best)


def _warn(median: float, best: float) -> None:
    global _warned
    if _warned:
        return
    _warned = True
    warnings.warn(
        f"update: the last {RECENT} updates took {1e3 * median:.3g} ms (median), {median / best:.0f} times the best, "
        f"{1e3 * best:.3g} ms. The likely cause: other processes are busy on the same cores, and OpenMP's threads spin "
        "while they wait for each other. Set OMP_WAIT_POLICY=PASSIVE in the environment before torch is imported, or "
        f"call torch.set_num_threads with the number of free cores (now {torch.get_num_threads()}).",
        RuntimeWarning,
        stacklevel=4,
    )


def paced(update: Update) -> Update:
    """Let a map's `update` note how long it takes on a CPU. On a GPU, where it returns early, nothing is noted."""

    @functools.wraps(update)
    def timed(emap: Any, /, *args: Any, **kwargs: Any) -> None:
        if torch.compiler.is_compiling():  # of the caller's own graph, which no clock belongs in
            return update(emap, *args, **kwargs)
        start = emap._pace.clock()
        update(emap, *args, **kwargs)
        points: Any = args[0] if args else kwargs["points"]
        if points.device.type == "cpu":
            emap._pace.note(emap._pace.clock() - start, points.numel() // 3)

    return cast(Update, timed)
