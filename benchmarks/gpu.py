"""One GPU: is its map the CPU's, does the host never wait, and how close is an update to what memory allows?

    python -m benchmarks.gpu                # benchmarks/results/gpu-NAME.json; needs torch, numpy and a CUDA device
    python -m benchmarks.gpu --device cpu   # a dry run: small sizes, no CUDA graph, nothing written

Each figure is written as soon as it is there.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from benchmarks import meter
from benchmarks.report import markdown_table, write_json
from benchmarks.speed_sections import fresh_compiler
from benchmarks.workload import BPEARL, Drive, full_config
from torchelev import ElevationMap

SCANS = 187  # points of a height scan
TARGETS = {"one robot, captured": 0.3, "many robots": 5.0, "height scans": 0.1}  # [ms]
BANDWIDTH = 5.0  # times what the necessary bytes take at the measured copy bandwidth


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


def host_never_waits(drive: Drive) -> bool:
    """Update, sample and reset while every wait of the host raises."""
    drive()
    xy, mask = (
        drive.clouds[0][..., :2].contiguous(),
        torch.ones(drive.emap.num_envs, dtype=torch.bool).to(drive.dt.device),
    )
    torch.cuda.set_sync_debug_mode("error")
    try:
        drive()
        drive.emap.sample(xy)
        drive.emap.reset(mask=mask)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return True


def one_robot(device: str, seconds: float) -> dict[str, Any]:
    """Time the paper's case: eager, compiled, captured."""
    result = {}
    for name, compiled in (("eager", False), ("compiled", True)):
        fresh_compiler()
        drive = Drive(full_config(), BPEARL, device=device, compiled=compiled)
        drive.warm_up()
        result[name] = meter.milliseconds(drive, seconds)
    result["kernels"] = slowest_kernels(drive)
    if device != "cpu":
        result["captured"] = meter.milliseconds(captured(drive), seconds)
    return result


def many_robots(device: str, robots: int, points: int, seconds: float) -> dict[str, Any]:
    """Time thousands of robots, and compare with what their bytes take to move."""
    fresh_compiler()
    cfg = full_config(64)
    drive = Drive(cfg, points, robots=robots, device=device, scans=2)
    drive.warm_up()
    result: dict[str, Any] = {"robots": robots, "points": points, "update": meter.milliseconds(drive, seconds)}
    moved = robots * meter.needed_traffic(cfg, points)
    bandwidth = meter.copy_bandwidth(device)
    result["necessary_bytes"], result["copy_gigabytes_per_second"] = moved, bandwidth / 1e9
    result["times_what_bytes_take"] = result["update"]["median"] / (1e3 * moved / bandwidth)
    kept = meter.state_bytes(cfg) + 12 * points
    result["bytes_per_robot"] = kept + meter.peak_bytes(drive, device) / robots
    result["needed_bytes_per_robot"] = meter.needed_memory(cfg, points)
    result["kernels"] = slowest_kernels(drive)
    emap = drive.emap
    xy = (emap.center[:, None, :2] + torch.rand(robots, SCANS, 2).to(device) - 0.5).float()
    sample = torch.compile(lambda layers, xy: emap.sample(xy, state=layers))
    with torch.no_grad():
        result["height scans"] = meter.milliseconds(lambda: emap.sample(xy), seconds)
        state = emap.state
        result["height scans, compiled"] = meter.milliseconds(lambda: sample(state, xy), seconds)
    result["reset"] = meter.milliseconds(emap.reset, seconds)
    if device != "cpu":
        result["captured"] = meter.milliseconds(captured(drive), seconds)
    return result


def slowest_kernels(drive: Drive) -> dict[str, float]:
    """Return the kernels that take longest in an update, with their time [ms]."""
    on_gpu = drive.dt.device.type == "cuda"
    activities = [ProfilerActivity.CPU, ProfilerActivity.CUDA] if on_gpu else [ProfilerActivity.CPU]
    with profile(activities=activities) as record:
        drive()
    kind = "self_device_time_total" if on_gpu else "self_cpu_time_total"
    events = sorted(record.key_averages(), key=lambda event: -getattr(event, kind))
    return {event.key[:100]: getattr(event, kind) / 1e3 for event in events[:25]}


def verdicts(result: dict[str, Any]) -> str:
    """Tabulate what was aimed at."""
    one, many = result["one robot"], result["many robots"]
    scans = min(many[name]["median"] for name in ("height scans", "height scans, compiled"))
    update = min(many[name]["median"] for name in ("update", "captured") if name in many)
    figures = [
        ("one robot, captured", one.get("captured", one["compiled"])["median"], TARGETS["one robot, captured"], "ms"),
        (f"{many['robots']} robots x {many['points']} points", update, TARGETS["many robots"], "ms"),
        ("the same, over its bytes", many["times_what_bytes_take"], BANDWIDTH, "x"),
        (f"height scans of {many['robots']} robots", scans, TARGETS["height scans"], "ms"),
    ]
    rows = [[case, f"{v:.3f} {unit}", f"<= {t} {unit}", "met" if v <= t else "missed"] for case, v, t, unit in figures]
    return markdown_table(["case", "measured", "target", ""], rows)


def main() -> None:
    """Check, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="where to run (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=1.0, help="time for each figure [s] (default: %(default)s)")
    parser.add_argument("--out", default="benchmarks/results", help="folder for the JSON (default: %(default)s)")
    args = parser.parse_args()
    dry = args.device == "cpu"
    if not dry and not torch.cuda.is_available():
        parser.error("no CUDA device: run on a machine that has one, or --device cpu for a dry run")
    result: dict[str, Any] = {}

    def note(name: str, values: Any) -> None:
        result[name] = values
        print(f"{name}: {json.dumps(values, indent=1)}", flush=True)
        if not dry:
            slug = "-".join(re.findall(r"[a-z0-9]+", torch.cuda.get_device_name().lower()))
            write_json(f"{args.out}/gpu-{slug}.json", result)

    note("correctness", correctness(args.device))
    if not dry:
        for compiled in (False, True):
            fresh_compiler()
            drive = Drive(full_config(64), 1024, robots=8, device=args.device, compiled=compiled)
            note(f"host never waits, {'compiled' if compiled else 'eager'}", host_never_waits(drive))
    note("one robot", one_robot(args.device, args.seconds))
    robots, points = (8, 512) if dry else (4096, 3072)
    note("many robots", many_robots(args.device, robots, points, args.seconds))
    print(verdicts(result))


if __name__ == "__main__":
    main()
