"""Compare the two engines of a site: files, and Icechunk, which keeps each merge as a version. Time, disk, memory.

    python -m benchmarks.speed.site.site_engines  # benchmarks/results/site_engines.json, five minutes
    python -m benchmarks.speed.site.site_engines --merges 10 --out here  # quicker, rougher

256 robots with windows of 64 x 64 cells, which overlap their neighbours by half, merge as in `site_merge`. Engines take
turns, forwards and backwards, on the same windows and must end with the same cells; figures are medians. Icechunk drops
no version until it is compacted.

A commit alone, opening and reading concern the storage: all tiles of the site, read-only, files in the system's cache.
Compacting keeps the newest snapshot. Memory is the largest of a process that merges, beyond one that merges in memory.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any

import click
import numpy as np
import torch

from benchmarks import RESULTS
from benchmarks.speed.common.meter import in_new_process, peak_megabytes, progress
from benchmarks.speed.site.site_windows import RESOLUTION, Windows, lattice
from torchelev.app.results import markdown_table, write_json
from torchelev.site import SiteConfig, SiteMap
from torchelev.site.storage.engines import open_store

SIZES_AT = (1, 10, 100)  # merges
STEP = 4  # [cells] of a round
ENGINES = ("files", "icechunk")
LIMIT = 1.3  # figures of Icechunk that are so many times those of files are marked


@dataclass(frozen=True)
class Sizes:
    """The robots, their windows [cells], and how often each thing is done."""

    robots: int = 256
    cells: int = 64  # along each side
    spacing: int = 32  # between neighbours
    repeats: int = 20  # of commits, opening and reading; a quarter as many first merges
    memory_merges: int = 10
    apart: Callable[..., Any] = in_new_process


def new_site(engine: str, folder: Path) -> SiteMap:
    """Return a site in an empty folder; or in memory."""
    if engine == "memory":
        return SiteMap(RESOLUTION)
    cfg = SiteConfig(keep_versions=1_000_000)
    return SiteMap(RESOLUTION, folder / engine, cfg=cfg, engine=engine)  # type: ignore[arg-type]


def open_engine(engine: str, folder: Path, *, read_only: bool = True) -> Any:
    """Open the store of what `new_site` has made."""
    return open_store(folder / engine, read_only=read_only)


def in_turn(rounds: int) -> Iterator[str]:
    """Yield all engines, forwards and backwards, so often."""
    for number in range(rounds):
        yield from ENGINES[:: 1 if number % 2 else -1]


class Times:
    """Times of each engine [ms]."""

    def __init__(self) -> None:
        self.all: dict[str, dict[str, list[float]]] = {engine: {} for engine in ENGINES}

    def take(self, engine: str, name: str, run: Callable[[], Any]) -> Any:
        """Time a call, and return its result."""
        start = time.perf_counter()
        result = run()
        self.all[engine].setdefault(name, []).append(1e3 * (time.perf_counter() - start))
        return result

    def medians(self, engine: str) -> dict[str, float]:
        """Return an engine's figures."""
        return {name: median(values) for name, values in self.all[engine].items()}


def time_first_merges(times: Times, sizes: Sizes) -> None:
    """Merge into new sites."""
    windows = Windows(sizes.robots, sizes.cells)
    windows.look(lattice(sizes.robots, sizes.spacing))
    for engine in in_turn(max(1, sizes.repeats // 4)):
        with tempfile.TemporaryDirectory() as folder, new_site(engine, Path(folder)) as site:
            times.take(engine, "first_ms", lambda site=site: site.merge(windows.emap))  # type: ignore[misc]


def grow(folder: Path, times: Times, merges: int, sizes: Sizes) -> dict[str, dict[str, int]]:
    """Merge into one site of each engine, in turn; return their sizes after some merges."""
    windows, corner = Windows(sizes.robots, sizes.cells), lattice(sizes.robots, sizes.spacing)
    sites = {engine: new_site(engine, folder) for engine in ENGINES}
    disk: dict[str, dict[str, int]] = {engine: {} for engine in ENGINES}
    for number in progress(range(1, merges + 1), "merges"):
        windows.look(corner + STEP * number)
        for engine in ENGINES[:: 1 if number % 2 else -1]:
            times.take(engine, "steady_ms", lambda site=sites[engine]: site.merge(windows.emap))  # type: ignore[misc]
            if number in SIZES_AT:
                disk[engine][f"bytes_{number}"] = sites[engine].num_bytes
    for site in sites.values():
        site.close()
    for engine in ENGINES:
        del times.all[engine]["steady_ms"][0]
    return disk


def time_commits(times: Times, tiles: list[tuple[int, int]], values: np.ndarray, sizes: Sizes) -> None:
    """Commit all tiles of a site again and again."""
    with tempfile.TemporaryDirectory() as name:
        for engine in ENGINES:
            new_site(engine, Path(name)).close()
        stores = {engine: open_engine(engine, Path(name), read_only=False) for engine in ENGINES}
        attributes = {key: value for key, value in stores["files"].attributes.items() if value is not None}
        for engine in in_turn(sizes.repeats):
            times.take(engine, "commit_ms", lambda store=stores[engine]: store.commit(tiles, values, attributes))  # type: ignore[misc]
        for store in stores.values():
            store.close()


def time_reading(folder: Path, times: Times, sizes: Sizes, after: str = "") -> tuple[list[tuple[int, int]], np.ndarray]:
    """Open the sites and read all of their tiles; return these, which must be the same."""
    results: dict[str, Any] = {}
    for engine in in_turn(sizes.repeats):
        store = times.take(engine, f"open{after}_ms", lambda engine=engine: open_engine(engine, folder))  # type: ignore[misc]
        tiles = sorted(store.tiles)
        results[engine] = tiles, times.take(engine, f"read{after}_ms", lambda: store.read(tiles))  # noqa: B023
    first = results["files"]
    for tiles, values in results.values():
        assert tiles == first[0] and np.array_equal(values, first[1], equal_nan=True)
    return first


def compact(folder: Path, times: Times) -> dict[str, dict[str, int]]:
    """Drop all snapshots but the newest; return the sizes, and the numbers of files before."""
    disk = {}
    for engine in ENGINES:
        files = sum(len(names) for _, _, names in os.walk(folder / engine))
        with open_engine(engine, folder, read_only=False) as store:
            if engine != "files":  # which keep no history
                times.take(engine, "compact_ms", lambda: store.compact(1))
            disk[engine] = {"files": files, "bytes_compacted": store.num_bytes}
    return disk


def peak(engine: str, sizes: Sizes) -> float:
    """Return the memory of this process after some merges [MB]."""
    torch.set_num_threads(1)
    windows, corner = Windows(sizes.robots, sizes.cells), lattice(sizes.robots, sizes.spacing)
    with tempfile.TemporaryDirectory() as folder, new_site(engine, Path(folder)) as site:
        for number in range(sizes.memory_merges):
            windows.look(corner + STEP * number)
            site.merge(windows.emap)
    return peak_megabytes()


def measure(merges: int, sizes: Sizes) -> list[dict[str, Any]]:
    """Return the figures of each engine."""
    times = Times()
    time_first_merges(times, sizes)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        disk = grow(folder, times, merges, sizes)
        tiles, values = time_reading(folder, times, sizes)
        compacted = compact(folder, times)
        time_reading(folder, times, sizes, "_compacted")
    time_commits(times, tiles, values, sizes)
    names = ("memory", *ENGINES, *ENGINES[::-1], "memory")
    peaks = [(engine, sizes.apart(peak, engine, sizes)) for engine in progress(names, "memory")]
    megabytes = {engine: min(value for name, value in peaks if name == engine) for engine in names}
    return [
        {"engine": engine, "tiles": len(tiles)} | times.medians(engine) | disk[engine] | compacted[engine]
        | {"peak_mb": megabytes[engine] - megabytes["memory"], "all": times.all[engine]}
        for engine in ENGINES
    ]  # fmt: skip


def table(rows: list[dict[str, Any]]) -> str:
    """Tabulate the figures, and how many times those of files Icechunk's are."""
    names = {
        "first_ms": "first merge [ms]",
        "steady_ms": "steady merge [ms]",
        "commit_ms": "commit of all tiles, alone [ms]",
        "open_ms": "open [ms]",
        "open_compacted_ms": "open, compacted [ms]",
        "read_ms": "read all tiles [ms]",
        "read_compacted_ms": "read all tiles, compacted [ms]",
        **{f"bytes_{number}": f"on disk after {number} merge{'s' * (number > 1)} [MB]" for number in SIZES_AT},
        "bytes_compacted": "on disk, compacted [MB]",
        "files": "files after the last merge",
        "compact_ms": "compact [ms]",
        "peak_mb": "memory [MB]",
    }
    lines = [_line(label, [row.get(name) for row in rows], name) for name, label in names.items()]
    return markdown_table(["", *(row["engine"] for row in rows), "Icechunk / files"], lines)


def _line(label: str, values: list[float | None], name: str) -> list[str]:
    scale = 1e6 if name.startswith("bytes") else 1
    digits = 0 if name in ("files", "peak_mb") else 1
    shown = ["–" if value is None else f"{value / scale:,.{digits}f}" for value in values]
    files, icechunk = values
    if not files or icechunk is None or name == "compact_ms":
        return [label, *shown, "–"]
    ratio = icechunk / files
    return [label, *shown, f"**{ratio:.2f}**" if ratio > LIMIT else f"{ratio:.2f}"]


def versions() -> Mapping[str, str]:
    """Return those of the packages that matter."""
    return {name: version(name) for name in ("icechunk", "zarr", "tensorstore")}


@click.command(help=__doc__)
@click.option("--merges", default=100, show_default=True, help="Into each site.")
@click.option("--threads", default=1, show_default=True, help="CPU threads of torch.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Output folder.")
@click.pass_obj
def main(sizes: Sizes | None, merges: int, threads: int, out: Path) -> None:
    """Measure, write JSON and print the table."""
    torch.set_num_threads(threads)
    sizes = sizes or Sizes()
    rows = measure(merges, sizes)
    write_json(out / "site_engines.json", {"merges": merges, "robots": sizes.robots, **versions(), "rows": rows})
    click.echo(table(rows))


if __name__ == "__main__":
    main()
