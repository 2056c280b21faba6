"""Time merging the windows of 1 to 1,024 robots into a site, in memory and on disk.

    python -m benchmarks.speed.site.site_merge  # benchmarks/results/site_merge.json, three minutes
    python -m benchmarks.speed.site.site_merge --rounds 3 --out here  # quicker, rougher

Each robot has a window of 64 x 64 cells of 10 cm, which overlaps its neighbours by half. In each round the windows move
by 4 cells along both axes, and all of their cells are measured anew. The first merge meets an empty site; steady is the
median of the later ones, with the alignment. What fills the windows is not timed.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import click
import torch

from benchmarks import RESULTS
from benchmarks.speed.common.meter import peak_bytes, progress
from benchmarks.speed.site.site_windows import RESOLUTION, Windows, lattice
from torchelev.app.results import markdown_table, write_json
from torchelev.site import SiteMap

STEP = 4  # [cells] of a round
PLACES = ("memory", "disk")


@dataclass(frozen=True)
class Sizes:
    """The numbers of robots, and their windows [cells]."""

    robots: tuple[int, ...] = (1, 16, 64, 256, 1024)
    cells: int = 64  # along each side
    spacing: int = 32  # between neighbours


def measure(num_robots: int, rounds: int, sizes: Sizes) -> dict[str, Any]:
    """Time the merges of a number of robots into two sites, in turn."""
    windows = {place: Windows(num_robots, sizes.cells) for place in PLACES}
    corner = lattice(num_robots, sizes.spacing)
    with tempfile.TemporaryDirectory() as folder:
        with SiteMap(RESOLUTION) as in_memory, SiteMap(RESOLUTION, Path(folder) / "site") as on_disk:
            sites = dict(zip(PLACES, (in_memory, on_disk), strict=True))
            ms: dict[str, list[float]] = {place: [] for place in PLACES}
            for number in range(rounds + 1):
                for place, site in sites.items():
                    windows[place].look(corner + STEP * number)
                    start = time.perf_counter()
                    report = site.merge(windows[place].emap)
                    ms[place].append(1e3 * (time.perf_counter() - start))
            error = report.offsets - windows["disk"].offsets
            windows["memory"].look(corner + STEP * (rounds + 1))
            peak = peak_bytes(lambda: in_memory.merge(windows["memory"].emap))
            size = {"tiles": len(on_disk), "disk_bytes": on_disk.num_bytes, "peak_bytes": peak}
    times = {place: {"first": values[0], "steady": median(values[1:]), "all": values} for place, values in ms.items()}
    return {"robots": num_robots} | size | times | {"offset_spread_m": float(error.max() - error.min())}


def table(rows: list[dict[str, Any]]) -> str:
    """Tabulate the times of merges [ms], and their memory."""
    head = ["robots", "tiles", "in memory: first [ms]", "steady [ms]", "on disk: first [ms]", "steady [ms]"]
    head += ["ms per robot, on disk", "memory of a merge [MB]", "on disk [MB]"]
    lines = []
    for row in rows:
        times = [f"{row[place][kind]:.1f}" for place in PLACES for kind in ("first", "steady")]
        each = f"{row['disk']['steady'] / row['robots']:.2f}"
        sizes = [f"{row[name] / 1e6:.1f}" for name in ("peak_bytes", "disk_bytes")]
        lines.append([f"{row['robots']:,}", f"{row['tiles']:,}", *times, each, *sizes])
    return markdown_table(head, lines)


@click.command(help=__doc__)
@click.option("--rounds", default=20, show_default=True, help="Merges after the first.")
@click.option("--threads", default=1, show_default=True, help="CPU threads.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Output folder.")
@click.pass_obj
def main(sizes: Sizes | None, rounds: int, threads: int, out: Path) -> None:
    """Measure, write JSON and print the table."""
    torch.set_num_threads(threads)
    sizes = sizes or Sizes()
    rows = [measure(robots, rounds, sizes) for robots in progress(sizes.robots, "robots")]
    write_json(out / "site_merge.json", {"rounds": rounds, "rows": rows})
    click.echo(table(rows))


if __name__ == "__main__":
    main()
