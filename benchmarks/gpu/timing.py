"""Times of updates and height scans on a GPU, and the figures to compare them with the memory's bandwidth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

from benchmarks.speed.common import meter
from benchmarks.speed.common.workload import BPEARL, Drive, full_config

_SCAN_POINTS = 187  # of a height scan
Figure = tuple[str, Callable[[], Any]]  # its name and the call that measures it


def _graph(run: Callable[[], Any]) -> torch.cuda.CUDAGraph:
    """Return a call as one CUDA graph, captured by torch: one launch instead of hundreds."""
    side_stream = torch.cuda.Stream()
    side_stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side_stream):  # compile and warm up outside the graph
        for _ in range(3):
            run()
    torch.cuda.current_stream().wait_stream(side_stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        run()
    return graph


def _captured(drive: Drive) -> Callable[[], None]:
    """Return a drive whose update is one CUDA graph."""
    points, T = (value.clone() for value in drive.next_scan())
    graph = _graph(lambda: drive.emap.update(points, T, T, drive.dt))

    def replay() -> None:
        scan, pose = drive.next_scan()
        points.copy_(scan)
        T.copy_(pose)
        graph.replay()

    return replay


def one_robot(device: str, seconds: float) -> Iterator[Figure]:
    """Time the paper's case, one robot: eager, compiled, captured."""
    for name, compiled in (("eager", False), ("compiled", True)):
        drive = Drive(full_config(), BPEARL, device=device, compiled=compiled)
        drive.warm_up()
        yield f"one robot, {name}", partial(meter.milliseconds, drive, seconds)
        yield f"one robot, {name}, slowest kernels", partial(_slowest_kernels, drive)
    if device != "cpu":
        yield "one robot, captured", lambda: meter.milliseconds(_captured(drive), seconds)
        yield (
            "one robot, captured, waiting for each",
            lambda: meter.milliseconds(_synchronized(_captured(drive)), seconds),
        )


def _synchronized(run: Callable[[], None]) -> Callable[[], None]:
    """Make the host wait after each call, which measures latency instead of throughput."""

    def run_and_wait() -> None:
        run()
        torch.cuda.synchronize()

    return run_and_wait


def many_robots(device: str, seconds: float) -> Iterator[Figure]:
    """Time thousands of robots, on a CPU eight, and measure the traffic and bandwidth to compare the time with."""
    robots, points = (8, 512) if device == "cpu" else (4096, 3072)
    cfg = full_config(64)
    drive = Drive(cfg, points, robots=robots, device=device, scans=2)
    drive.warm_up()
    yield "many robots, update", lambda: meter.milliseconds(drive, seconds)
    yield "many robots, slowest kernels", lambda: _slowest_kernels(drive)
    yield "many robots", lambda: {"robots": robots, "points": points, "cells": cfg.grid.num_cells}
    yield "many robots, expected bytes", lambda: robots * meter.needed_traffic(cfg, points)
    yield "copy, bytes per second", lambda: meter.copy_bandwidth(device)
    kept = meter.state_bytes(cfg) + 12 * points
    yield "many robots, bytes per robot", lambda: kept + meter.peak_bytes(drive, device) / robots
    yield "many robots, needed bytes per robot", lambda: meter.needed_memory(cfg, points)
    emap = drive.emap
    xy = (emap.center[:, None, :2] + torch.rand(robots, _SCAN_POINTS, 2).to(device) - 0.5).float()
    sample = torch.compile(lambda state, xy: emap.sample(xy, state=state))
    with torch.no_grad():
        yield "height scans", lambda: meter.milliseconds(lambda: emap.sample(xy), seconds)
        yield "height scans, compiled", lambda: meter.milliseconds(lambda: sample(emap.state, xy), seconds)
    if device != "cpu":
        with torch.no_grad():
            yield "height scans, captured", lambda: _time_captured(lambda: sample(emap.state, xy), seconds)
        yield "many robots, captured", lambda: meter.milliseconds(_captured(drive), seconds)
    yield "reset", lambda: meter.milliseconds(emap.reset, seconds)


def _time_captured(run: Callable[[], Any], seconds: float) -> dict[str, float]:
    return meter.milliseconds(_graph(run).replay, seconds)


def _slowest_kernels(drive: Drive) -> dict[str, float]:
    """Return the 20 slowest kernels of an update with their times [ms]; on a CPU, the operators."""
    on_gpu = drive.dt.device.type == "cuda"
    activities = [ProfilerActivity.CPU, ProfilerActivity.CUDA] if on_gpu else [ProfilerActivity.CPU]
    with profile(activities=activities) as record:
        drive()
    kind = DeviceType.CUDA if on_gpu else DeviceType.CPU  # an operator's entry repeats its kernels' time
    events = [event for event in record.key_averages() if event.device_type == kind]
    field = "self_device_time_total" if on_gpu else "self_cpu_time_total"
    slowest = sorted(events, key=lambda event: getattr(event, field), reverse=True)[:20]  # [us]
    return {f"{event.key[:60]} ... {event.key[-40:]}": round(getattr(event, field) / 1e3, 4) for event in slowest}
