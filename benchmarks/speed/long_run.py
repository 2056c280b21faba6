"""Check that an update's time, the process's memory and the number of compiled graphs do not grow in long runs.

    python -m benchmarks.speed.long_run        # 100,000 updates of one robot, 10,000 of 256: about 20 minutes

The robots drive straight on, and the scans differ in their numbers of points. The result is written after each
hundredth of a run, so Ctrl-C loses nothing; an interrupted run cannot be resumed, because growth happens within one
process.

The load of a shared machine changes more slowly than a measurement lasts, so it affects two processes alike that are
timed in turn: after each hundredth, a reference process that has done a twentieth of the updates is timed, and in the
end a new one.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
import torch.utils.benchmark as bench
from torch._dynamo.utils import counters
from tqdm import tqdm

from benchmarks import RESULTS
from benchmarks.speed.common.growth import plot, table, verdicts
from benchmarks.speed.common.workload import BPEARL, MANY_POINTS, Drive, full_config
from torchelev.app.results import commit, write_json

CASES = {"one robot": (1, 250, BPEARL, 100_000), "256 robots": (256, 64, MANY_POINTS, 10_000)}
Case = tuple[int, int, int, int]  # robots, cells along each side, points, updates
Start = Callable[[Case], tuple[Any, Any]]  # a drive and the timer of its updates
NewProcess = Callable[[Case], contextlib.AbstractContextManager[Callable[[int], float]]]
BLOCKS = 100
ROUNDS = 30  # in which this process and a new one are timed in turn
_REFERENCE = 20  # updates of this process per update of the reference process


def resident_bytes() -> int:
    """Return the resident memory of this process [bytes]."""
    pages = Path("/proc/self/statm").read_text().split()[1]
    return int(pages) * 4096


def onward(drive: Drive) -> None:
    """Let the robots drive straight on, and give each scan its own number of points."""
    drive.clouds = [cloud[:, k * cloud.shape[1] // 40 :].contiguous() for k, cloud in enumerate(drive.clouds)]
    plain = drive.next_scan

    def next_scan() -> tuple[torch.Tensor, torch.Tensor]:
        cloud, T = plain()
        T = T.clone()
        T[:, 0, 3] = 0.04 * drive.step
        return cloud, T

    drive.next_scan = next_scan  # type: ignore[method-assign]


def start(case: Case) -> tuple[Drive, bench.Timer]:
    """Make the robots of a case and the timer of their updates."""
    robots, side, points, _ = case
    counters.clear()
    drive = Drive(full_config(side), points, robots=robots, scans=8 if robots == 1 else 4)
    onward(drive)
    drive.watch(8)
    return drive, bench.Timer("drive()", globals={"drive": drive}, num_threads=torch.get_num_threads())


def milliseconds(timer: bench.Timer, updates: int) -> float:
    """Return the mean time of an update [ms]."""
    return 1e3 * timer.timeit(updates).mean


@functools.cache
def started(case: Case, threads: int) -> bench.Timer:
    """Start a case in this new process at the first call."""
    torch.set_num_threads(threads)
    return start(case)[1]


def _new_milliseconds(case: Case, threads: int, updates: int) -> float:
    """Return the mean time of an update in a new process [ms]."""
    return milliseconds(started(case, threads), updates)


@contextlib.contextmanager
def _new_process(case: Case) -> Iterator[Callable[[int], float]]:
    """Start a case in a new process; yield a function that returns the mean time of its next updates [ms]."""
    threads, spawn = torch.get_num_threads(), get_context("spawn")  # a fork would inherit this process's state
    with ProcessPoolExecutor(1, spawn) as new:

        def time(updates: int) -> float:
            return new.submit(_new_milliseconds, case, threads, updates).result()

        time(1)
        yield time


def _beside_new(time_new: Callable[[int], float], timer: bench.Timer, updates: int) -> dict[str, list[float]]:
    """Time the updates of this process and of a new one in turn [ms]."""
    times: dict[str, list[float]] = {"old_ms": [], "new_ms": []}
    for _ in range(ROUNDS):
        times["new_ms"].append(time_new(updates))
        times["old_ms"].append(milliseconds(timer, updates))
    return times


def run_case(
    name: str,
    case: Case,
    updates: int,
    save: Callable[[dict[str, Any]], None],
    start: Start = start,
    new_process: NewProcess = _new_process,
) -> None:
    """Run a case in blocks; save the time per update, memory and graphs of each, then time a new process."""
    robots, side, points, _ = case
    drive, timer = start(case)
    size = max(1, updates // BLOCKS)
    values: dict[str, Any] = {"robots": robots, "points": points, "cells": side**2, "block": size}
    values |= {"ms": [], "reference_ms": [], "resident_bytes": [], "graphs": []}
    with new_process(case) as time_reference:
        for _ in tqdm(range(math.ceil(updates / size)), desc=name, disable=None):
            values["ms"].append(milliseconds(timer, size))
            values["reference_ms"].append(time_reference(max(1, size // _REFERENCE)))
            values["resident_bytes"].append(resident_bytes())
            values["graphs"].append(counters["stats"]["unique_graphs"])
            values["updates"] = size * len(values["ms"])
            values["known_share"] = float(drive.emap.state.validity.float().mean())
            save(values)
    with new_process(case) as time_new:
        save(values | _beside_new(time_new, timer, max(1, size // 10)))


def main(argv: Sequence[str] | None = None, cases: Mapping[str, Case] = CASES, **how: Any) -> int:
    """Run the cases, write JSON and plot, and fail if something grows; `how`: of `run_case`."""
    args = _arguments(argv)
    path = (args.out or RESULTS) / "long_run.json"
    torch.set_num_threads(args.threads)
    result: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    interrupted = False
    for name in args.cases or cases:

        def save(values: dict[str, Any], name: str = name) -> None:
            result[name] = {"commit": commit()} | values
            write_json(path, result)

        try:
            run_case(name, cases[name], int(args.share * cases[name][3]), save, **how)
        except KeyboardInterrupt:
            interrupted = True
            break
    done = {name: result[name] for name in cases if "reference_ms" in result.get(name, {})}  # older results lack it
    if done:
        plot(done, path.with_suffix(".png"))
        print(f"{table(done)}\n\n{'interrupted; ' if interrupted else ''}wrote {path} and its picture")
    return 130 if interrupted else int(any(row[-1] == "GROWS" for row in verdicts(done)))


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed.long_run",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"any of {', '.join(map(repr, CASES))} (default: all)")
    parser.add_argument("--out", type=Path, help="output folder (default: benchmarks/results, for complete runs only)")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads (default: %(default)s)")
    parser.add_argument(
        "--share", type=float, default=1.0, help="fraction of the updates to run (default: %(default)s)"
    )
    args = parser.parse_args(argv)
    if unknown := [name for name in args.cases if name not in CASES]:
        parser.error(f"unknown case {', '.join(unknown)}; choose from {', '.join(CASES)}")
    if not 0 < args.share <= 1:
        parser.error(f"--share must lie in (0, 1], got {args.share:g}")
    if args.share < 1 and args.out is None:
        parser.error("--share would overwrite the results of complete runs; give another folder with --out")
    return args


if __name__ == "__main__":
    sys.exit(main())
