"""Measure how a site on disk behaves while it grows to a square kilometre in cells of 10 cm.

    python -m benchmarks.speed.site.site_area  # benchmarks/results/site_area.json; six minutes, 1 GB
    python -m benchmarks.speed.site.site_area --sides 100 --out here  # quicker: 100 x 100 m alone

16 robots with windows of 16 x 16 m hop over the area, with 4 m of overlap; all cells of each window are new. For each
area a new process explores it, and another one then opens, samples and reads it. Memory is the largest that a process
had (VmHWM, without the file cache), beyond that of a process that imports torch alone.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import click
import torch

from benchmarks import RESULTS
from benchmarks.speed.common.meter import in_new_process, milliseconds, peak_megabytes, progress, state_bytes
from benchmarks.speed.site.site_windows import RESOLUTION, Windows
from torchelev.app.results import markdown_table, write_json
from torchelev.site import SiteMap

SIDES = (100, 316, 1000)  # [m]


@dataclass(frozen=True)
class Sizes:
    """Who explores, what is read, and how long reading is timed."""

    robots: int = 16
    cells: int = 160  # along each side of a window
    hop: int = 120  # [cells] between places
    num_samples: int = 10_000
    window: float = 20.0  # [m] of an area that is read
    seconds: float = 2.0
    apart: Callable[..., Any] = in_new_process


def hops(side: float, sizes: Sizes) -> torch.Tensor:
    """Return the corners (K, B, 2) [cells] of windows that cover a square of `side` [m]; the last ones start anew."""
    count = max(1, round((side / RESOLUTION - sizes.cells) / sizes.hop) + 1)
    number = torch.arange(-(-(count**2) // sizes.robots) * sizes.robots) % count**2
    row, column = number // count, number % count
    column = torch.where(row % 2 == 0, column, count - 1 - column)
    return sizes.hop * torch.stack([row, column], 1).view(-1, sizes.robots, 2)


def explore(folder: Path, side: float, sizes: Sizes) -> dict[str, Any]:
    """Explore an area, and return the times of all merges and the memory of this process."""
    torch.set_num_threads(1)
    windows, ms = Windows(sizes.robots, sizes.cells), []
    with SiteMap(RESOLUTION, folder) as site:
        for corner in hops(side, sizes):
            windows.look(corner)
            start = time.perf_counter()
            site.merge(windows.emap)
            ms.append(1e3 * (time.perf_counter() - start))
        size = {"tiles": len(site), "disk_bytes": site.num_bytes}
    maps = sizes.robots * state_bytes(windows.emap.cfg) / 1e6
    return size | {"merge_ms": ms, "explorer_mb": peak_megabytes(), "maps_mb": maps}


def read(folder: Path, side: float, sizes: Sizes) -> dict[str, Any]:
    """Open a site, sample it at random points and read a window of it; return the times and the memory."""
    torch.set_num_threads(1)
    start = time.perf_counter()
    site = SiteMap.open(folder, read_only=True)
    open_ms = 1e3 * (time.perf_counter() - start)
    generator = torch.Generator().manual_seed(0)

    def points(length: float) -> torch.Tensor:
        return length * torch.rand(sizes.num_samples, 2, generator=generator, dtype=torch.float64)

    times = {
        "sample_ms": lambda: site.sample(points(side)),
        "sample_near_ms": lambda: site.sample(points(sizes.window)),
        "window_ms": lambda: site.window((side / 2, side / 2), sizes.window, sizes.window, ["elevation"]),
    }
    known = site.sample(points(side))[1].double().mean()
    result = {name: milliseconds(run, sizes.seconds)["median"] for name, run in times.items()}
    return result | {"open_ms": open_ms, "known": float(known), "reader_mb": peak_megabytes()}


def torch_megabytes() -> float:
    """Return the memory of a process that imports torch alone [MB]."""
    code = "import torch; print(next(line for line in open('/proc/self/status') if line.startswith('VmHWM')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return int(done.stdout.split()[1]) * 1024 / 1e6


def measure(side: float, sizes: Sizes) -> dict[str, Any]:
    """Explore and read an area, each in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        values: dict[str, Any] = {"side": side, "torch_mb": torch_megabytes()}
        for run in (explore, read):
            values |= sizes.apart(run, Path(folder) / "site", side, replace(sizes, apart=in_new_process))
    return values


def table(rows: list[dict[str, Any]]) -> str:
    """Tabulate the figures of each area."""
    lines: dict[str, list[str]] = {
        "tiles": [f"{row['tiles']:,}" for row in rows],
        "on disk [MB]": [f"{row['disk_bytes'] / 1e6:,.1f}" for row in rows],
        "merges of 16 robots": [f"{len(row['merge_ms']):,}" for row in rows],
        "merge, median of the last quarter [ms]": [f"{_last_quarter(row['merge_ms']):.0f}" for row in rows],
        "open [ms]": [f"{row['open_ms']:.0f}" for row in rows],
        "sample 10,000 points anywhere [ms]": [f"{row['sample_ms']:,.0f}" for row in rows],
        "sample 10,000 points within 20 × 20 m [ms]": [f"{row['sample_near_ms']:.1f}" for row in rows],
        "read 20 × 20 m [ms]": [f"{row['window_ms']:.1f}" for row in rows],
        "memory of exploring, beyond torch [MB]": [f"{row['explorer_mb'] - row['torch_mb']:.0f}" for row in rows],
        "of these, the 16 maps [MB]": [f"{row['maps_mb']:.0f}" for row in rows],
        "memory of reading, beyond torch [MB]": [f"{row['reader_mb'] - row['torch_mb']:.0f}" for row in rows],
    }
    head = ["", *(f"{row['side']:,} × {row['side']:,} m" for row in rows)]
    return markdown_table(head, [[name, *cells] for name, cells in lines.items()])


def _last_quarter(times: list[float]) -> float:
    return median(times[-max(1, len(times) // 4) :])


@click.command(help=__doc__)
@click.option("--sides", type=int, multiple=True, default=SIDES, show_default=True, help="Sides of the areas [m].")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Output folder.")
@click.pass_obj
def main(sizes: Sizes | None, sides: tuple[int, ...], out: Path) -> None:
    """Measure, write JSON and print the table."""
    sizes = sizes or Sizes()
    rows = [measure(side, sizes) for side in progress(sides, "areas")]
    write_json(out / "site_area.json", {"robots": sizes.robots, "rows": rows})
    click.echo(table(rows))


if __name__ == "__main__":
    main()
