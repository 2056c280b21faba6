"""How the time of an update grows with the points, robots, cells and ray length."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch

from benchmarks.speed.common import meter
from benchmarks.speed.common.meter import progress
from benchmarks.speed.common.workload import BPEARL, MANY_POINTS, SENSORS, Drive, baseline_config, full_config
from torchelev.stages.visibility.polar_table import PolarGrid

THREADS = (1, 2)
_STEEPNESS = 0.5  # slope of the long rays: above the exclusion ramp at any distance


@dataclass(frozen=True)
class Sizes:
    """What the sections measure."""

    points: tuple[int, ...] = (1000, 3000, 6276, 15000, 43074, 100000, 200000, 407040)
    of_sensors: tuple[int, ...] = tuple(sorted(row[1] for row in SENSORS))  # points
    robots: tuple[int, ...] = (1, 4, 16, 64, 256, 1024, 4096)
    cells: tuple[int, ...] = (125, 250, 500, 1000)  # along each side
    rays: tuple[float, ...] = (1.2, 1.7, 2.4, 3.4, 4.8, 6.8, 19.2, 38.4)  # [m] of the longest; the window ends at 5 m
    many_robots: int = 256


USUAL = Sizes()


def points(seconds: float, sizes: Sizes = USUAL) -> dict[str, Any]:
    """Time one robot's update against the number of points: all stages, the paper's plain baseline, uncompiled."""
    drives = {("full", n): Drive(full_config(), n) for n in sizes.points}
    drives |= {("baseline", n): Drive(baseline_config(), n) for n in sizes.points}
    drives |= {("eager", n): Drive(full_config(), n, compiled=False) for n in sizes.of_sensors}
    for (kind, _), drive in progress(drives.items(), "points"):
        drive.watch(8) if kind == "baseline" else drive.warm_up()
    times = meter.interleaved(drives, seconds)
    results: dict[str, Any] = {"full": [], "baseline": [], "eager": []}
    for (kind, n), drive in drives.items():
        moved = meter.needed_traffic(drive.emap.cfg, n)
        row: dict[str, Any] = {"points": n} | times[kind, n] | {"necessary_bytes": moved}
        row["gigabytes_per_second"] = moved / row["median"] / 1e6
        results[kind].append(row | {"largest_statistics": drive.seen})
    numbers, medians = [row["points"] for row in results["full"]], [row["median"] for row in results["full"]]
    results["exponent"] = meter.exponent(numbers, medians)
    first = numbers.index(BPEARL)
    results["exponent_from_43074"] = meter.exponent(numbers[first:], medians[first:])
    return results


def threads(seconds: float, sizes: Sizes = USUAL) -> dict[str, Any]:
    """Time updates of one robot and of many on one thread and on two, against the bytes that they must move."""
    before = torch.get_num_threads()
    try:
        return {"rows": [row for number in progress(THREADS, "threads") for row in _on_threads(number, seconds, sizes)]}
    finally:
        torch.set_num_threads(before)


def _on_threads(number: int, seconds: float, sizes: Sizes) -> Iterator[dict[str, Any]]:
    full, many = full_config(), full_config(64)
    cases = {f"{n:,} points": (full, n, 1) for n in sizes.of_sensors}
    cases[f"{sizes.many_robots} robots"] = (many, MANY_POINTS, sizes.many_robots)
    torch.set_num_threads(number)
    drives = {name: Drive(cfg, n, robots=count) for name, (cfg, n, count) in cases.items()}
    for drive in drives.values():
        drive.watch(8)
    bandwidth = meter.copy_bandwidth()
    for name, time in meter.interleaved(drives, seconds).items():
        cfg, n, count = cases[name]
        share = count * meter.needed_traffic(cfg, n) / (time["median"] / 1e3) / bandwidth
        yield {"case": name, "threads": number} | time | {"share_of_copy": share}


def robots(seconds: float, sizes: Sizes = USUAL) -> dict[str, Any]:
    """Time an update, and record its memory, against the number of robots."""
    cfg = full_config(64)
    needed = meter.needed_memory(cfg, MANY_POINTS)
    moved = meter.needed_traffic(cfg, MANY_POINTS)
    rows = []
    for count in progress(sizes.robots, "robots"):
        drive = Drive(cfg, MANY_POINTS, robots=count, scans=4)
        drive.warm_up()
        time = meter.milliseconds(drive, seconds)
        temporary = meter.peak_bytes(drive) / count
        kept = meter.state_bytes(cfg) + 12 * MANY_POINTS
        memory = {"temporary_bytes_per_robot": temporary, "bytes_per_robot": kept + temporary}
        rate = {"gigabytes_per_second": moved * count / time["median"] / 1e6}
        rows.append({"robots": count} | time | {"ms_per_robot": time["median"] / count} | memory | rate)
    return {"cells": 64, "points": MANY_POINTS, "needed_bytes_per_robot": needed, "rows": rows}


def cells(seconds: float, sizes: Sizes = USUAL) -> dict[str, Any]:
    """Time one robot's update against the number of cells."""
    drives = {side**2: Drive(full_config(side), BPEARL, reach=5.0) for side in sizes.cells}
    for drive in progress(drives.values(), "cells"):
        drive.watch(8)
    times = meter.interleaved(drives, seconds)
    rows = [{"cells": count} | time for count, time in times.items()]
    exponent = meter.exponent(sizes.cells[1:], [row["median"] for row in rows[1:]]) / 2  # cells are sides squared
    return {"points": BPEARL, "rows": rows, "exponent": exponent}


def rays(seconds: float, sizes: Sizes = USUAL) -> dict[str, Any]:
    """Time one robot's update against the length of half of its rays; the other half measures the ground nearby.

    The long rays rise above the exclusion ramp at one slope. They contribute no heights, so their cost is that of ray
    casting alone. A ray costs no more once it has left the polar table, so only lengths within it enter the exponent.
    """
    cfg = full_config()
    assert cfg.raycast
    table_length = PolarGrid.of(cfg.grid, cfg.raycast).ranges * cfg.grid.resolution
    drives = {length: Drive(cfg, BPEARL, scans=4, reach=sizes.rays[0]) for length in sizes.rays}
    for length, drive in progress(drives.items(), "rays"):
        generator = torch.Generator().manual_seed(0)
        for cloud in drive.clouds:
            far = cloud[:, ::2]
            reach = length * (0.9 + 0.1 * torch.rand(far[..., :1].shape, generator=generator))
            far[..., :2] *= reach / far[..., :2].norm(dim=-1, keepdim=True)
            far[..., 2:] = _STEEPNESS * reach
        drive.watch(8)
        work = {name: drive.seen[name] for name in ("points_used", "drift_points", "cells_bounded")}
        assert min(work.values()) > 0, f"rays of {length} m: nothing to do, {work}"
    times = meter.interleaved(drives, seconds)
    rows = [
        {"metres": length} | time | {"bounded": drives[length].seen["cells_bounded"]} for length, time in times.items()
    ]
    inside = [row for row in rows if row["metres"] <= table_length]
    exponent = meter.exponent([row["metres"] for row in inside], [row["median"] for row in inside])
    return {"points": BPEARL, "rows": rows, "exponent": exponent}
