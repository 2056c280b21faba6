"""How the speed benchmarks measure: times, memory, and the bytes that an update must move at least."""

from __future__ import annotations

import json
import math
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import torch
import torch.utils.benchmark as bench
from torch.profiler import ProfilerActivity, profile

from torchelev import ElevationMapConfig
from torchelev.stages.visibility.polar_table import PolarGrid
from torchelev.state import blank_state

Name = TypeVar("Name")
Value = TypeVar("Value")


def progress(values: Iterable[Value], name: str) -> Iterator[Value]:
    """Yield the values and show a progress bar if stderr is a terminal."""
    from tqdm import tqdm  # which a GPU machine may lack

    yield from tqdm(list(values), desc=name, disable=None, leave=False)


def in_new_process(function: Callable[..., Value], *arguments: Any) -> Value:
    """Call a function in a new process, which inherits no memory of this one."""
    with ProcessPoolExecutor(1, get_context("spawn")) as new:
        return new.submit(function, *arguments).result()


def milliseconds(run: Callable[[], Any], seconds: float) -> dict[str, float]:
    """Time a callable with torch's benchmark timer: median, minimum and interquartile range [ms]."""
    return interleaved({"": run}, seconds, rounds=1)[""]


def interleaved(
    runs: Mapping[Name, Callable[[], Any]], seconds: float, rounds: int = 5
) -> dict[Name, dict[str, float]]:
    """Time several callables in turn, so that the load of a shared machine affects all alike.

    Each gets `seconds` in total, divided over `rounds`.
    """
    threads = torch.get_num_threads()
    timers = {name: bench.Timer("run()", globals={"run": run}, num_threads=threads) for name, run in runs.items()}
    # Each time is the mean of this many calls in all rounds, so that their minima are comparable.
    calls = {name: max(1, round(1e-3 / timer.timeit(1).mean)) for name, timer in timers.items()}
    times: dict[Name, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, timer in timers.items():
            end = time.perf_counter() + seconds / rounds
            while not times[name] or time.perf_counter() < end:
                times[name].append(timer.timeit(calls[name]).mean)
    return {name: _summary(values) for name, values in times.items()}


def _summary(times: list[float]) -> dict[str, float]:
    """Return median, minimum, interquartile range, 90th and 99th percentile [ms] of times [s]."""
    cuts = statistics.quantiles(times, n=100, method="inclusive") if len(times) > 1 else [times[0]] * 99
    p25, median, p75, p90, p99 = (1e3 * cuts[k - 1] for k in (25, 50, 75, 90, 99))
    return {"median": median, "min": 1e3 * min(times), "iqr": p75 - p25, "p90": p90, "p99": p99}


def peak_bytes(run: Callable[[], Any], device: str = "cpu") -> int:
    """Return the peak memory that a call allocates beyond what was allocated before."""
    if device != "cpu":
        torch.cuda.synchronize()
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        run()
        torch.cuda.synchronize()
        return torch.cuda.max_memory_allocated() - before
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as record:
        run()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trace.json"
        record.export_chrome_trace(str(path))
        events = json.loads(path.read_text())["traceEvents"]
    held, peak = 0, 0
    for event in sorted((e for e in events if e["name"] == "[memory]"), key=lambda e: (e["ts"], e["args"]["Ev Idx"])):
        held += event["args"]["Bytes"]
        peak = max(peak, held)
    return peak


def peak_megabytes() -> float:
    """Return the largest memory that this process had in its life [MB]."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) * 1024 / 1e6


def copy_bandwidth(device: str = "cpu", megabytes: int = 256) -> float:
    """Return the memory bandwidth of copying a large tensor [bytes/s], reads and writes together."""
    source = torch.ones(megabytes * 2**18, device=device)
    target = torch.empty_like(source)
    return 2 * source.nbytes / (milliseconds(lambda: target.copy_(source), 1.0)["min"] / 1e3)


def state_bytes(cfg: ElevationMapConfig) -> int:
    """Return the size of one robot's map [bytes]."""
    state = blank_state(cfg.grid, 1, "meta", torch.float32)
    return sum(value.nbytes for value in (*state[:-1], *state.statistics))


def table_bytes(cfg: ElevationMapConfig) -> int:
    """Return the size of one robot's polar table [bytes]."""
    if cfg.raycast is None:
        return 0
    polar = PolarGrid.of(cfg.grid, cfg.raycast)
    return 4 * polar.ranges * polar.azimuths


def needed_memory(cfg: ElevationMapConfig, points: int) -> int:
    """Return the minimum memory of one robot [bytes]: map, points and polar table."""
    return state_bytes(cfg) + 12 * points + table_bytes(cfg)


def needed_traffic(cfg: ElevationMapConfig, points: int) -> int:
    """Return the minimum traffic of one robot's update [bytes]: map and table in and out once, points in once."""
    return 2 * state_bytes(cfg) + 12 * points + 2 * table_bytes(cfg)


def exponent(sizes: Sequence[float], times: Sequence[float]) -> float:
    """Fit times = a * sizes^p by least squares of the logarithms and return p."""
    x, y = ([math.log(v) for v in values] for values in (sizes, times))
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    return sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)) / sum((a - mean_x) ** 2 for a in x)
