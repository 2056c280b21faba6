"""Time merges of the same robots into a site that 1, 2 or 4 processes share.

    python -m benchmarks.speed.site.site_ranks

Robots stand on a square 8 m apart, with windows of 12 x 12 m at 10 cm that know all their ground, and measure it anew
before each merge. Processes are on this machine, with one thread each and gloo. All ranks align and fuse the robots of
all, so that more processes do not shorten a merge: they map in parallel. Writes benchmarks/results/site_ranks.json.
"""

from __future__ import annotations

import os
import pickle
import statistics
import tempfile
import time
from datetime import timedelta
from pathlib import Path
from typing import Any

import click
import torch
import torch.distributed as dist
import torch.multiprocessing as multiprocessing

from benchmarks import RESULTS
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.app.results import markdown_table, write_json
from torchelev.site import SiteMap
from torchelev.site.shared.packing import Layout

RESOLUTION, LENGTH, SPACING = 0.1, 12.0, 8.0


def measure(num_robots: int, sizes: list[int], merges: int) -> list[dict[str, Any]]:
    """Time merges for each number of processes, in memory and on disk."""
    return [_measure(num_robots, size, on_disk, merges) for on_disk in (False, True) for size in sizes]


def _measure(num_robots: int, size: int, on_disk: bool, merges: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        multiprocessing.spawn(_rank, (size, num_robots, on_disk, merges, folder), nprocs=size)
        times = [pickle.loads((folder / str(rank)).read_bytes()) for rank in range(size)]
    seconds = [max(each) for each in zip(*times, strict=True)]  # of the slowest rank
    cells = round(LENGTH / RESOLUTION)
    bytes_per_robot = [
        Layout(cells, cells, with_contribution).num_bytes if size > 1 else 0 for with_contribution in (False, True)
    ]
    quarters = statistics.quantiles(seconds[1:], n=4)
    own = {"processes": size, "robots": num_robots, "on_disk": on_disk, "first_ms": 1e3 * seconds[0]}
    later = {"median_ms": 1e3 * quarters[1], "iqr_ms": 1e3 * (quarters[2] - quarters[0])}
    return own | later | {"first_bytes": num_robots * bytes_per_robot[0], "bytes": num_robots * bytes_per_robot[1]}


def _rank(rank: int, size: int, num_robots: int, on_disk: bool, merges: int, folder: Path) -> None:
    """Time merges of this rank's share of the robots."""
    torch.set_num_threads(1)
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    store = dist.FileStore(str(folder / "store"), size)
    dist.init_process_group("gloo", store=store, rank=rank, world_size=size, timeout=timedelta(seconds=60))
    site = SiteMap(RESOLUTION, folder / "site" if on_disk else None, group=dist.group.WORLD)
    emap, times = _robots(range(rank * num_robots // size, (rank + 1) * num_robots // size), num_robots), []
    for _ in range(merges):
        emap.state.elapsed.add_(10**9)
        dist.barrier()
        start = time.perf_counter()
        site.merge(emap)
        times.append(time.perf_counter() - start)
    (folder / str(rank)).write_bytes(pickle.dumps(times))
    site.close()
    dist.barrier()
    dist.destroy_process_group()


def _robots(ids: range, num_robots: int) -> ElevationMap:
    """Return a map of some of the robots."""
    side = int(num_robots**0.5 + 0.999)
    grid = GridConfig(resolution=RESOLUTION, length_x=LENGTH, length_y=LENGTH)
    emap, step = ElevationMap(ElevationMapConfig(grid=grid), len(ids)), round(SPACING / RESOLUTION)
    emap.corner.copy_(torch.tensor([[k % side * step, k // side * step] for k in ids]))
    x, y = emap.cell_centers().unbind(-1)
    state, offset = emap.state, 0.01 * torch.tensor(ids)[:, None, None]
    state.elevation.copy_(0.3 * torch.sin(0.3 * x) * torch.cos(0.2 * y) + offset)
    state.gradient_x.copy_(0.09 * torch.cos(0.3 * x) * torch.cos(0.2 * y))
    state.gradient_y.copy_(-0.06 * torch.sin(0.3 * x) * torch.sin(0.2 * y))
    state.variance.fill_(1e-4)
    state.validity.fill_(True)
    state.has_normal.fill_(True)
    return emap


def table(result: dict[str, Any]) -> str:
    """Tabulate times [ms] and megabytes."""
    rows = []
    for row in result["rows"]:
        place = "on disk" if row["on_disk"] else "in memory"
        numbers = [f"{row['first_ms']:.0f}", f"{row['median_ms']:.0f} ± {row['iqr_ms'] / 2:.0f}"]
        megabytes = [f"{row[name] / 1e6:.2f}" for name in ("first_bytes", "bytes")]
        rows.append([place, str(row["processes"]), str(row["robots"]), *numbers, *megabytes])
    head = ["site", "processes", "robots", "first merge [ms]", "later merge [ms]", "gathered first [MB]", "later [MB]"]
    return markdown_table(head, rows)


@click.command(help=__doc__)
@click.option("--robots", default=16, show_default=True, help="Robots of all processes.")
@click.option("--merges", default=15, show_default=True, help="Merges for each row.")
@click.option("--processes", default="1,2,4", show_default=True, help="Numbers of processes.")
def main(robots: int, merges: int, processes: str) -> None:
    """Measure, write JSON and print the table."""
    torch.set_num_threads(1)
    result: dict[str, Any] = {"resolution": RESOLUTION, "length": LENGTH, "merges": merges}
    result["rows"] = measure(robots, [int(size) for size in processes.split(",")], merges)
    write_json(RESULTS / "site_ranks.json", result)
    click.echo(table(result))


if __name__ == "__main__":
    main()
