"""Long runs: does an update's time, the process's memory or the number of compiled graphs grow?

    python -m benchmarks.speed.long_run        # 100,000 updates of one robot, 10,000 of 256: about 20 minutes

The robots drive on and on, and no two scans of a round have the same number of points. The result is written after
each hundredth of a run, so that Ctrl-C loses nothing; growth within a process cannot be resumed in another.

A shared machine's good and bad minutes last longer than what is sought, and hit alike two processes that are timed in
turn: after each hundredth, one that does a twentieth of the updates, and in the end a new one.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import math
import statistics
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
import torch.utils.benchmark as bench
from torch._dynamo.utils import counters
from tqdm import tqdm

from benchmarks.speed.sections import fresh_compiler
from benchmarks.speed.workload import BPEARL, MANY_POINTS, Drive, full_config
from torchelev.app.results import commit, markdown_table, write_json

CASES = {"one robot": (1, 250, BPEARL, 100_000), "256 robots": (256, 64, MANY_POINTS, 10_000)}
Case = tuple[int, int, int, int]  # robots, cells along each side, points, updates
BLOCKS = 100
ROUNDS = 30  # of this process and a new one, in turn
REFERENCE = 20  # updates of this process to one of the other
GROWTH = 1.05  # of the last quarter over the first, and of this process over a new one
RESULTS = Path("benchmarks/results")


def resident_bytes() -> int:
    """Return what the process holds in memory now."""
    pages = Path("/proc/self/statm").read_text().split()[1]
    return int(pages) * 4096


def onward(drive: Drive) -> None:
    """Let the robots drive on for ever, and give each scan its own number of points."""
    drive.clouds = [cloud[:, k * cloud.shape[1] // 40 :].contiguous() for k, cloud in enumerate(drive.clouds)]
    plain = drive.next_scan

    def next_scan() -> tuple[torch.Tensor, torch.Tensor]:
        cloud, T = plain()
        T = T.clone()
        T[:, 0, 3] = 0.04 * drive.step
        return cloud, T

    drive.next_scan = next_scan  # type: ignore[method-assign]


def start(case: Case) -> tuple[Drive, bench.Timer]:
    """Make the robots of a case, on their way, and what times them."""
    robots, side, points, _ = case
    fresh_compiler()
    counters.clear()
    drive = Drive(full_config(side), points, robots=robots, scans=8 if robots == 1 else 4)
    onward(drive)
    drive.watch(8)
    return drive, bench.Timer("drive()", globals={"drive": drive}, num_threads=torch.get_num_threads())


def milliseconds(timer: bench.Timer, updates: int) -> float:
    """Return the mean time of so many updates [ms]."""
    return 1e3 * timer.timeit(updates).mean


@functools.cache
def started(case: Case, threads: int) -> bench.Timer:
    """Start a case in a new process, at the first call."""
    torch.set_num_threads(threads)
    return start(case)[1]


def new_milliseconds(case: Case, threads: int, updates: int) -> float:
    """Return the mean time of so many updates in a new process [ms]."""
    return milliseconds(started(case, threads), updates)


@contextlib.contextmanager
def new_process(case: Case) -> Iterator[Callable[[int], float]]:
    """Start a case in a new process; give what times so many of its updates [ms]."""
    threads, spawn = torch.get_num_threads(), get_context("spawn")  # a fork would inherit what this one has become
    with ProcessPoolExecutor(1, spawn) as new:

        def time(updates: int) -> float:
            return new.submit(new_milliseconds, case, threads, updates).result()

        time(1)
        yield time


def beside_new(case: Case, timer: bench.Timer, updates: int) -> dict[str, list[float]]:
    """Time so many updates of this process and of a new one in turn [ms]."""
    times: dict[str, list[float]] = {"old_ms": [], "new_ms": []}
    with new_process(case) as time_new:
        for _ in range(ROUNDS):
            times["new_ms"].append(time_new(updates))
            times["old_ms"].append(milliseconds(timer, updates))
    return times


def run_case(name: str, updates: int, save: Callable[[dict[str, Any]], None]) -> None:
    """Run in blocks; save the time per update, memory and graphs of each, and the end beside a new process."""
    robots, side, points, _ = case = CASES[name]
    drive, timer = start(case)
    size = max(1, updates // BLOCKS)
    values: dict[str, Any] = {"robots": robots, "points": points, "cells": side**2, "block": size}
    values |= {"ms": [], "reference_ms": [], "resident_bytes": [], "graphs": []}
    with new_process(case) as time_reference:
        for _ in tqdm(range(math.ceil(updates / size)), desc=name, disable=None):
            values["ms"].append(milliseconds(timer, size))
            values["reference_ms"].append(time_reference(max(1, size // REFERENCE)))
            values["resident_bytes"].append(resident_bytes())
            values["graphs"].append(counters["stats"]["unique_graphs"])
            values["updates"] = size * len(values["ms"])
            values["known_share"] = float(drive.emap.validity.float().mean())
            save(values)
    save(values | beside_new(case, timer, max(1, size // 10)))


def growth(series: list[float]) -> float:
    """Return the last quarter's median over the first's."""
    part = max(1, len(series) // 4)
    return statistics.median(series[-part:]) / statistics.median(series[:part])


def ratios(times: list[float], others: list[float]) -> list[float]:
    """Divide times by those taken in turn with them."""
    return [time / other for time, other in zip(times, others, strict=True)]


def verdicts(result: dict[str, Any]) -> list[list[str]]:
    """Tabulate growth of time and memory, and the graphs compiled."""
    rows = []
    for name, values in result.items():
        time, memory = growth(values["ms"]), growth(values["resident_bytes"])
        paired = growth(ratios(values["ms"], values["reference_ms"]))
        beside = statistics.median(ratios(values.get("old_ms", []), values.get("new_ms", [])) or [math.nan])
        graphs = values["graphs"][-1]
        holds = max(paired, beside, memory) <= GROWTH and graphs == values["graphs"][0]
        figures = [f"{time:.2f}", f"{paired:.2f}", f"{beside:.2f}", f"{memory:.3f}", f"{graphs}"]
        verdict = "none grows" if holds else "GROWS"
        whole = len(values["ms"]) >= 10 and beside > 0
        rows.append([name, f"{values['updates']:,}", *figures, verdict if whole else "too short"])
    return rows


def table(result: dict[str, Any]) -> str:
    """Tabulate the cases."""
    beside = ["time over a reference's", "time over a new process's"]
    head = ["case", "updates", "time alone", *beside, "memory", "graphs compiled", ""]
    return markdown_table(head, verdicts(result))


def plot(result: dict[str, Any], path: Path) -> None:
    """Draw time per update and memory over the updates."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(result), figsize=(9, 3.2), layout="constrained", squeeze=False)
    for ax, (name, values) in zip(axes.flat, result.items(), strict=True):
        updates = [values["block"] * (k + 1) for k in range(len(values["ms"]))]
        ax.plot(updates, values["ms"], label="time")
        ax.plot(updates, values["reference_ms"], color="C0", alpha=0.35, label="time of a reference")
        ax.set(xlabel="updates", ylabel="time per update [ms]", title=name)
        ax.set_ylim(bottom=0)
        memory = ax.twinx()
        memory.plot(updates, [b / 1e6 for b in values["resident_bytes"]], color="C1", label="memory")
        memory.set_ylabel("memory of the process [MB]")
        memory.set_ylim(0, 1.3e-6 * max(values["resident_bytes"]))
        ax.legend(handles=[*ax.lines, *memory.lines], fontsize=8, loc="lower right")
    figure.savefig(path, dpi=90)


def main() -> int:
    """Run the cases, write JSON and plot, and fail if something grows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join(map(repr, CASES))}; default: all")
    parser.add_argument("--out", type=Path, help=f"folder (default: {RESULTS}, for whole runs only)")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads (default: %(default)s)")
    parser.add_argument("--share", type=float, default=1.0, help="of the updates to run (default: %(default)s)")
    args = parser.parse_args()
    if unknown := [name for name in args.cases if name not in CASES]:
        parser.error(f"unknown case {', '.join(unknown)}: there are {', '.join(CASES)}")
    if not 0 < args.share <= 1:
        parser.error(f"--share must lie in (0, 1], not {args.share:g}")
    if args.share < 1 and args.out is None:
        parser.error("--share would replace whole runs by a part of one: give another folder with --out")
    path = (args.out or RESULTS) / "long_run.json"
    torch.set_num_threads(args.threads)
    result: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    interrupted = False
    for name in args.cases or CASES:

        def save(values: dict[str, Any], name: str = name) -> None:
            result[name] = {"commit": commit()} | values
            write_json(path, result)

        try:
            run_case(name, int(args.share * CASES[name][3]), save)
        except KeyboardInterrupt:
            interrupted = True
            break
    cases = {name: result[name] for name in CASES if "reference_ms" in result.get(name, {})}  # older ones lack it
    if cases:
        plot(cases, path.with_suffix(".png"))
        print(f"{table(cases)}\n\n{'interrupted; ' if interrupted else ''}wrote {path} and its picture")
    return 130 if interrupted else int(any(row[-1] == "GROWS" for row in verdicts(cases)))


if __name__ == "__main__":
    sys.exit(main())
