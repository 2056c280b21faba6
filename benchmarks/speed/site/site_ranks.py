"""Time merges of the same robots into a site that 1, 2 or 4 processes share.

    python -m benchmarks.speed.site.site_ranks  # benchmarks/results/site_ranks.json, four minutes
    python -m benchmarks.speed.site.site_ranks --robots 64 --repeats 1 --out here  # quicker, rougher

Robots have windows of 64 x 64 cells of 10 cm, each of which overlaps its neighbours by half. Before each merge the
windows move by 4 cells along both axes, and all of their cells are measured anew. Processes are on this machine, with
one thread each and gloo; each one has as many robots. A merge takes as long as the slowest process, whose CPU time and
largest memory are listed, too. The numbers of processes are run in turn, several times.
"""

from __future__ import annotations

import os
import pickle
import tempfile
import time
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from statistics import median
from typing import Any

import click
import torch
import torch.distributed as dist
import torch.multiprocessing as multiprocessing

from benchmarks import RESULTS
from benchmarks.speed.common.meter import peak_megabytes, progress
from benchmarks.speed.site.site_windows import RESOLUTION, Windows, lattice
from torchelev.app.results import markdown_table, write_json
from torchelev.site import SiteMap

CELLS, SPACING, STEP = 64, 32, 4


@dataclass(frozen=True)
class Sizes:
    """How often what is merged."""

    robots: int = 1024  # of all processes
    merges: int = 7  # of one run, after the first
    repeats: int = 3  # runs of each number of processes


def measure(sizes: Sizes, processes: list[int]) -> list[dict[str, Any]]:
    """Time merges for each number of processes, in memory and on disk."""
    rows = [{"processes": n, "robots": sizes.robots, "on_disk": place} for place in (False, True) for n in processes]
    runs: list[list[dict[str, Any]]] = [[] for _ in rows]
    for _ in progress(range(sizes.repeats), "repeats"):
        for row, its_runs in zip(rows, runs, strict=True):
            its_runs.append(_measure(sizes, row["processes"], bool(row["on_disk"])))
    return [row | _summarise(its_runs) for row, its_runs in zip(rows, runs, strict=True)]


def _summarise(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return medians over all merges after the first."""
    later = {name: [value for run in runs for value in run[name][1:]] for name in ("ms", "cpu_ms")}
    own = {"first_ms": median(run["ms"][0] for run in runs), "all_ms": [run["ms"] for run in runs]}
    return (
        own
        | {f"median_{name}": median(values) for name, values in later.items()}
        | {
            "megabytes": median(run["megabytes"] for run in runs),
            "merge_megabytes": median(run["merge_megabytes"] for run in runs),
        }
    )


def _measure(sizes: Sizes, processes: int, on_disk: bool) -> dict[str, Any]:
    """Return time [ms], CPU time and memory of the slowest, or largest, process."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        multiprocessing.spawn(_rank, (processes, sizes, on_disk, folder), nprocs=processes)
        ranks = [pickle.loads((folder / str(rank)).read_bytes()) for rank in range(processes)]
    ms, cpu_ms = ([max(each) for each in zip(*(rank[k] for rank in ranks), strict=True)] for k in ("ms", "cpu_ms"))
    return {"ms": ms, "cpu_ms": cpu_ms} | {k: max(r[k] for r in ranks) for k in ("megabytes", "merge_megabytes")}


def _rank(rank: int, size: int, sizes: Sizes, on_disk: bool, folder: Path) -> None:
    """Time merges of this rank's share of the robots."""
    torch.set_num_threads(1)
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    store = dist.FileStore(str(folder / "store"), size)
    dist.init_process_group("gloo", store=store, rank=rank, world_size=size, timeout=timedelta(seconds=60))
    site = SiteMap(RESOLUTION, folder / "site" if on_disk else None, group=dist.group.WORLD)
    own = slice(rank * sizes.robots // size, (rank + 1) * sizes.robots // size)
    corner = lattice(sizes.robots, SPACING)[own]
    windows, result = Windows(len(corner), CELLS), dict[str, list[float]](ms=[], cpu_ms=[])
    windows.look(corner)
    before = peak_megabytes()
    for number in range(sizes.merges + 1):
        windows.look(corner + STEP * number)
        dist.barrier()
        start, cpu_start = time.perf_counter(), time.process_time()
        site.merge(windows.emap)
        result["ms"].append(1e3 * (time.perf_counter() - start))
        result["cpu_ms"].append(1e3 * (time.process_time() - cpu_start))
    memory = {"megabytes": peak_megabytes(), "merge_megabytes": peak_megabytes() - before}
    (folder / str(rank)).write_bytes(pickle.dumps(result | memory))
    site.close()
    dist.barrier()
    dist.destroy_process_group()


def table(result: dict[str, Any]) -> str:
    """Tabulate times [ms] and memory [MB]."""
    rows, one = [], {row["on_disk"]: row["median_ms"] for row in result["rows"] if row["processes"] == 1}
    for row in result["rows"]:
        place, base = "on disk" if row["on_disk"] else "in memory", one.get(row["on_disk"])
        ratio = "" if base is None else f"{row['median_ms'] / base:.2f}"
        times = [f"{row[name]:.0f}" for name in ("first_ms", "median_ms")]
        others = [f"{row[name]:.0f}" for name in ("median_cpu_ms", "megabytes", "merge_megabytes")]
        rows.append([place, str(row["processes"]), f"{row['robots']:,}", *times, ratio, *others])
    head = ["site", "processes", "robots", "first merge [ms]", "later merge [ms]", "ratio"]
    head += ["CPU time of a process [ms]", "memory of a process [MB]", "of these, merging [MB]"]
    return markdown_table(head, rows)


@click.command(help=__doc__)
@click.option("--robots", default=1024, show_default=True, help="Robots of all processes.")
@click.option("--merges", default=7, show_default=True, help="Merges of a run, after the first.")
@click.option("--repeats", default=3, show_default=True, help="Runs of each row, in turn.")
@click.option("--processes", default="1,2,4", show_default=True, help="Numbers of processes.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Output folder.")
def main(robots: int, merges: int, repeats: int, processes: str, out: Path) -> None:
    """Measure, write JSON and print the table."""
    torch.set_num_threads(1)
    result: dict[str, Any] = {"resolution": RESOLUTION, "cells": CELLS, "merges": merges, "repeats": repeats}
    result["rows"] = measure(Sizes(robots, merges, repeats), [int(size) for size in processes.split(",")])
    write_json(out / "site_ranks.json", result)
    click.echo(table(result))


if __name__ == "__main__":
    main()
