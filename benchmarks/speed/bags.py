"""Time reading, deskewing and mapping of bags, and check that memory does not grow with their length.

    python -m benchmarks.speed.bags     # benchmarks/results/bags.json, five minutes and 0.5 GB of disk

A robot drives in circles with a lidar of 32 rings. Bags are mapped as `torchelev map` does by default: cells of 10 cm,
20 x 20 m, not compiled. For each scan, reading it, reading and deskewing it, and fusing it are timed in turn.

Memory is that of a new process for each bag: what it holds when the map is empty, and its peak over the bag. Both are
of the process alone (VmHWM), without the file cache.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch

from benchmarks import RESULTS
from benchmarks.speed.common.bag_drive import CLOUDS, MAP_FRAME, POSES, SENSOR_FRAME, write_bag
from benchmarks.speed.common.meter import in_new_process, peak_megabytes, progress
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.app.results import markdown_table, write_json
from torchelev.io import MappingRun
from torchelev.io.bags import Bag, BagRecording, BagRequest, open_bag
from torchelev.io.bags.scans import read_scan
from torchelev.sim import Lidar

FORMATS = (".bag", ".mcap", ".db3")
GRID = GridConfig(resolution=0.1, length_x=20.0, length_y=20.0)
_REQUEST = BagRequest(clouds=(CLOUDS,), map_frame=MAP_FRAME, base_frame=SENSOR_FRAME, poses=POSES)
_STEPS = ("read", "deskew", "map")


@dataclass(frozen=True)
class Sizes:
    """The bags that are timed, and those whose memory is measured, each in a process of its own."""

    lidar: Lidar = Lidar(rings=32, azimuths=1024)
    timed_scans: int = 200
    small_lidar: Lidar = Lidar(rings=16, azimuths=512)
    lengths: tuple[int, ...] = (200, 2000)
    apart: Callable[..., Any] = in_new_process


def measure_times(paths: Sequence[Path], num_scans: int) -> list[dict[str, float]]:
    """Return the median time of each step [ms per scan] of each bag; deskewing includes the poses.

    The bags are mapped scan by scan in turn, so that the load of a shared machine affects all alike.
    """
    times = np.array(
        list(zip(*(_time_scans(path, num_scans) for path in paths), strict=True))
    )  # (scans, bags, steps) [s]
    return [dict(zip(_STEPS, row, strict=True)) for row in (1e3 * np.median(times, 0)).tolist()]


def _time_scans(path: Path, num_scans: int) -> Iterator[tuple[float, float, float]]:
    """Map a bag; yield the time of each step of each scan [s]."""
    run = MappingRun(ElevationMap(ElevationMapConfig(grid=GRID)))
    with Bag(path) as bag, Bag(path) as same:
        messages, frames = bag.read([CLOUDS]), iter(open_bag(same, _REQUEST))
        for _ in range(num_scans):
            start = time.perf_counter()
            read_scan(next(messages).data)
            read = time.perf_counter()
            frame = next(frames)
            whole = time.perf_counter()
            if frame is None:
                raise ValueError(f"{path}: a scan was left out")
            run.add(frame, frame.T_map_base)
            yield read - start, whole - read - (read - start), time.perf_counter() - whole


def measure_memory(path: Path) -> dict[str, float]:
    """Map a bag; return the memory of this process before the first scan and its peak [MB]."""
    torch.set_num_threads(1)
    run = MappingRun(ElevationMap(ElevationMapConfig(grid=GRID)))
    with Bag(path) as bag:
        recording: BagRecording = open_bag(bag, _REQUEST)
        start = peak_megabytes()
        for frame in recording:
            if frame is not None:
                run.add(frame, frame.T_map_base)
    return {"scans": run.num_scans, "start": start, "peak": peak_megabytes()}


def measure(folder: Path, sizes: Sizes) -> list[dict[str, Any]]:
    """Return the figures of each format; bags are written to a folder."""
    paths = [folder / f"drive{suffix}" for suffix in FORMATS]
    for path in paths:
        write_bag(path, sizes.timed_scans, sizes.lidar)
    times = measure_times(paths, sizes.timed_scans)
    return [
        {"format": path.suffix, "points": len(sizes.lidar.directions), "scans": sizes.timed_scans, "ms": ms}
        | {"memory_mb": [_measure_apart(path, length, sizes) for length in sizes.lengths]}
        for path, ms in progress(zip(paths, times, strict=True), "memory")
    ]


def _measure_apart(path: Path, num_scans: int, sizes: Sizes) -> dict[str, float]:
    """Write a bag and measure the memory of mapping it in a new process."""
    write_bag(path, num_scans, sizes.small_lidar)
    memory: dict[str, float] = sizes.apart(measure_memory, path)
    path.unlink()
    return memory


def table(rows: list[dict[str, Any]]) -> str:
    """Tabulate scans per second of each step and of all, and the memory over the lengths."""
    lengths = [int(memory["scans"]) for memory in rows[0]["memory_mb"]]
    head = ["format", "reading [1/s]", "deskewing [1/s]", "mapping [1/s]", "all [scans/s]"]
    head += [f"peak memory, {length:,} scans [MB]" for length in lengths]
    lines = [
        [row["format"], *(f"{1e3 / row['ms'][step]:.0f}" for step in _STEPS), f"{1e3 / sum(row['ms'].values()):.0f}"]
        + [f"{memory['peak']:.0f}" for memory in row["memory_mb"]]
        for row in rows
    ]
    return markdown_table(head, lines)


@click.command(help=__doc__)
@click.option("--threads", default=1, show_default=True, help="CPU threads.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Output folder.")
@click.pass_obj
def main(sizes: Sizes | None, threads: int, out: Path) -> None:
    """Measure, write JSON and print the table."""
    torch.set_num_threads(threads)
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(Path(folder), sizes or Sizes())
    write_json(out / "bags.json", {"rows": rows})
    click.echo(table(rows))


if __name__ == "__main__":
    main()
