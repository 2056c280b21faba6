"""One GPU: is its map the CPU's, does the host never wait, and how close is an update to what memory allows?

    python -m benchmarks.gpu                # benchmarks/results/gpu-NAME.json; needs torch, numpy and a CUDA device
    python -m benchmarks.gpu --device cpu   # a dry run: small sizes, no CUDA graph, nothing written

Each figure is written as soon as it is there.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

from benchmarks.speed import meter
from benchmarks.speed.sections import fresh_compiler
from benchmarks.speed.workload import BPEARL, Drive, full_config
from torchelev import ElevationMap
from torchelev.app.results import markdown_table, slug, write_json

SCANS = 187  # points of a height scan
Figure = tuple[str, Callable[[], Any]]  # its name, and what measures it


def captured(drive: Drive) -> Callable[[], None]:
    """Return a drive whose update is a CUDA graph, made by torch's own means: one launch in place of hundreds."""
    points, T = (value.clone() for value in drive.next_scan())
    others = torch.cuda.Stream()
    others.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(others):  # compile and warm up outside the graph
        for _ in range(3):
            drive.emap.update(points, T, T, drive.dt)
    torch.cuda.current_stream().wait_stream(others)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        drive.emap.update(points, T, T, drive.dt)

    def replay() -> None:
        scan, pose = drive.next_scan()
        points.copy_(scan)
        T.copy_(pose)
        graph.replay()

    return replay


def compare(first: ElevationMap, second: ElevationMap) -> dict[str, float]:
    """Return how far two maps agree: known cells, and heights of those that both know [m]."""
    known = [emap.validity.cpu() for emap in (first, second)]
    difference = (first.elevation.cpu() - second.elevation.cpu())[known[0] & known[1]].abs()
    worst = difference.sort().values
    return {
        "cells_known_by_one_alone": float((known[0] != known[1]).float().mean()),
        "median_difference_m": float(worst[len(worst) // 2]),
        "difference_m_999": float(worst[int(0.999 * (len(worst) - 1))]),
        "largest_difference_m": float(worst[-1]),
    }


def driven(device: str, compiled: bool, robots: int = 4, updates: int = 20) -> ElevationMap:
    """Return the maps of a few robots after some updates."""
    drive = Drive(full_config(64), 2048, robots=robots, device=device, compiled=compiled)
    for _ in range(updates):
        drive()
    return drive.emap


def correctness(device: str) -> dict[str, Any]:
    """Compare the GPU's maps with the CPU's, and with themselves from run to run."""
    on_cpu = driven("cpu", compiled=False)
    result: dict[str, Any] = {"eager": compare(driven(device, False), on_cpu)}
    fresh_compiler()
    result["compiled"] = compare(driven(device, True), on_cpu)
    result["run to run"] = compare(driven(device, False), driven(device, False))
    with deterministic():
        result["run to run, deterministic"] = compare(driven(device, False), driven(device, False))
    return result


@contextmanager
def deterministic() -> Iterator[None]:
    """Use deterministic algorithms for a while."""
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(False)


def host_never_waits(drive: Drive) -> dict[str, bool]:
    """Update, sample and reset while every wait of the host raises."""
    drive()
    xy, mask = drive.clouds[0][..., :2].contiguous(), drive.dt > 0
    torch.cuda.set_sync_debug_mode("error")
    try:
        drive()
        drive.emap.sample(xy)
        drive.emap.reset(mask=mask)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return {"holds": True}


def one_robot(device: str, seconds: float) -> Iterator[Figure]:
    """Time the paper's case: eager, compiled, captured."""
    for name, compiled in (("eager", False), ("compiled", True)):
        fresh_compiler()
        drive = Drive(full_config(), BPEARL, device=device, compiled=compiled)
        drive.warm_up()
        yield f"one robot, {name}", lambda drive=drive: meter.milliseconds(drive, seconds)
        yield f"one robot, {name}, slowest kernels", lambda drive=drive: slowest_kernels(drive)
    if device != "cpu":
        yield "one robot, captured", lambda: meter.milliseconds(captured(drive), seconds)
        yield "one robot, captured, waiting for each", lambda: meter.milliseconds(waiting(captured(drive)), seconds)


def waiting(run: Callable[[], None]) -> Callable[[], None]:
    """Let the host wait after each call: latency in place of throughput."""

    def run_and_wait() -> None:
        run()
        torch.cuda.synchronize()

    return run_and_wait


def many_robots(device: str, robots: int, points: int, seconds: float) -> Iterator[Figure]:
    """Time thousands of robots, with what is needed to compare with what their bytes take to move."""
    fresh_compiler()
    cfg = full_config(64)
    drive = Drive(cfg, points, robots=robots, device=device, scans=2)
    drive.warm_up()
    yield "many robots, update", lambda: meter.milliseconds(drive, seconds)
    yield "many robots, slowest kernels", lambda: slowest_kernels(drive)
    yield "many robots", lambda: {"robots": robots, "points": points, "cells": cfg.grid.num_cells}
    yield "many robots, expected bytes", lambda: robots * meter.needed_traffic(cfg, points)
    yield "copy, bytes per second", lambda: meter.copy_bandwidth(device)
    kept = meter.state_bytes(cfg) + 12 * points
    yield "many robots, bytes per robot", lambda: kept + meter.peak_bytes(drive, device) / robots
    yield "many robots, needed bytes per robot", lambda: meter.needed_memory(cfg, points)
    emap = drive.emap
    xy = (emap.center[:, None, :2] + torch.rand(robots, SCANS, 2).to(device) - 0.5).float()
    sample = torch.compile(lambda state, xy: emap.sample(xy, state=state))
    with torch.no_grad():
        yield "height scans", lambda: meter.milliseconds(lambda: emap.sample(xy), seconds)
        yield "height scans, compiled", lambda: meter.milliseconds(lambda: sample(emap.state, xy), seconds)
    if device != "cpu":
        yield "many robots, captured", lambda: meter.milliseconds(captured(drive), seconds)
    yield "reset", lambda: meter.milliseconds(emap.reset, seconds)


def slowest_kernels(drive: Drive) -> dict[str, float]:
    """Return the kernels that take longest in an update, with their time [ms]; on a CPU, the operators."""
    on_gpu = drive.dt.device.type == "cuda"
    activities = [ProfilerActivity.CPU, ProfilerActivity.CUDA] if on_gpu else [ProfilerActivity.CPU]
    with profile(activities=activities) as record:
        drive()
    kind = DeviceType.CUDA if on_gpu else DeviceType.CPU  # an operator's entry holds its kernels' time once more
    events = [event for event in record.key_averages() if event.device_type == kind]
    times = {
        event.key[:80]: (event.self_device_time_total if on_gpu else event.self_cpu_time_total) for event in events
    }
    return {key: round(times[key] / 1e3, 4) for key in sorted(times, key=times.__getitem__, reverse=True)[:20]}


def verdicts(result: dict[str, Any]) -> list[list[str]]:
    """Tabulate what was aimed at, as far as it was measured."""
    rows = []

    def check(case: str, value: float, limit: float, unit: str) -> None:
        rows.append([case, f"{value:.3f} {unit}", f"<= {limit} {unit}", "met" if value <= limit else "missed"])

    def fastest(*names: str) -> float | None:
        return min((result[name]["median"] for name in names if "median" in result.get(name, {})), default=None)

    repeats = result["correctness"].get("run to run, deterministic", {}).get("largest_difference_m", math.inf)
    check("largest difference between deterministic runs", repeats, 0, "m")
    waits = sum("error" in values for name, values in result.items() if name.startswith("host never waits"))
    check("kinds of update for which the host waits", waits, 0, "")
    one, scans = fastest("one robot, captured"), fastest("height scans", "height scans, compiled")
    many = fastest("many robots, update", "many robots, captured")
    if one is not None:
        check("one robot, captured", one, 0.3, "ms")
    if many is not None:
        check("many robots", many, 5.0, "ms")
        bytes_take = 1e3 * result["many robots, expected bytes"] / result["copy, bytes per second"]
        check("many robots, over what their bytes take", many / bytes_take, 5.0, "x")
    if scans is not None:
        check("height scans", scans, 0.1, "ms")
    return rows


def figures(device: str, seconds: float, dry: bool) -> Iterator[Figure]:
    """List what is measured."""
    yield "correctness", lambda: correctness(device)
    for compiled in () if dry else (False, True):
        fresh_compiler()
        drive = Drive(full_config(64), 1024, robots=8, device=device, compiled=compiled)
        name = f"host never waits, {'compiled' if compiled else 'eager'}"
        yield name, lambda drive=drive: host_never_waits(drive)
    yield from one_robot(device, seconds)
    yield from many_robots(device, *((8, 512) if dry else (4096, 3072)), seconds)


def main() -> int:
    """Check, measure, write; a figure that fails leaves its error, and the others go on."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"), help="(default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=1.0, help="time for each figure [s] (default: %(default)s)")
    parser.add_argument("--out", default="benchmarks/results", help="folder for the JSON (default: %(default)s)")
    args = parser.parse_args()
    dry = args.device == "cpu"
    if not dry and not torch.cuda.is_available():
        parser.error("no CUDA device: run on a machine that has one, or --device cpu for a dry run")
    result: dict[str, Any] = {}
    for name, measure in figures(args.device, args.seconds, dry):
        try:
            result[name] = measure()
        except RuntimeError as error:
            result[name] = {"error": str(error)[:500]}
        print(f"{name}: {json.dumps(result[name])[:300]}", flush=True)
        if not dry:
            write_json(f"{args.out}/gpu-{slug(torch.cuda.get_device_name())}.json", result)
    if dry:
        print("dry run: nothing is judged or written")
        return 0
    rows = verdicts(result)
    print(markdown_table(["case", "measured", "target", ""], rows))
    return int(any(row[-1] == "missed" for row in rows) or any("error" in str(values) for values in result.values()))


if __name__ == "__main__":
    sys.exit(main())
