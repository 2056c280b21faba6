"""The sections of `benchmarks.run`: each measures one question and returns what belongs into the JSON."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch._dynamo.utils import counters
from torch.utils._pytree import tree_map

from benchmarks import meter
from benchmarks.workload import BPEARL, MANY_POINTS, SENSORS, Drive, baseline_config, full_config
from torchelev import aging, drift, fusion, grid, overlap, pipeline, raycast, sensor
from torchelev.state import MapState, Measurement, map_layers
from torchelev.storage import as_bytes, as_mask

POINTS = [1000, 3000, 6276, 15000, 43074, 100000, 200000, 407040]
ROBOTS = [1, 4, 16, 64, 256, 1024, 4096]
CELLS = [125, 250, 500, 1000]  # along each side
RAYS = [1.2, 2.4, 4.8, 9.6, 19.2, 38.4]  # [m] horizontal length of the longest; the window ends at 5
Track = Callable[[Iterable], Iterable]  # shows progress


def fresh_compiler() -> None:
    """Forget compiled updates: one process keeps no more than eight, and the next would be told to be general."""
    torch._dynamo.reset()
    pipeline.compiled_update.cache_clear()


def points(seconds: float, track: Track) -> dict[str, Any]:
    """Time one robot's update against the number of points: all stages, the paper's plain baseline, eager."""
    results: dict[str, Any] = {}
    for kind, cfg in (("full", full_config()), ("baseline", baseline_config())):
        fresh_compiler()
        counters.clear()
        results[kind] = []
        for n in track(POINTS):
            drive = Drive(cfg, n)
            drive.warm_up() if kind == "full" else drive.watch(8)
            moved = meter.needed_traffic(cfg, n)
            time = meter.milliseconds(drive, seconds)
            rate = moved / time["median"] / 1e6
            row = {"points": n} | time | {"necessary_bytes": moved, "gigabytes_per_second": rate}
            results[kind].append(row | {"largest_statistics": drive.seen} if kind == "full" else row)
        results[f"{kind}_graphs"] = counters["stats"]["unique_graphs"]
    results["eager"] = []
    for _, n, _, _ in track(SENSORS):
        drive = Drive(full_config(), n, compiled=False)
        drive.warm_up()
        results["eager"].append({"points": n} | meter.milliseconds(drive, seconds))
    rows = results["full"]
    sizes, times = [row["points"] for row in rows], [row["median"] for row in rows]
    results["exponent"] = meter.exponent(sizes, times)
    many = sizes.index(BPEARL)
    results["exponent_from_43074"] = meter.exponent(sizes[many:], times[many:])
    return results


def stages(seconds: float, track: Track) -> dict[str, Any]:
    """Time each stage compiled on its own (paper, Table I). Their sum exceeds the whole, which the compiler fuses."""
    cfg = full_config()
    drive = Drive(cfg, BPEARL, compiled=False)
    drive.warm_up()
    cloud, T = drive.next_scan()
    g = cfg.grid
    assert cfg.drift and cfg.raycast and cfg.overlap and cfg.traversability

    def transform(state: MapState, m: Measurement) -> Measurement:
        return sensor.measure(cloud[:, None], T[:, None], T, drive.dt, None, g, cfg.sensor, torch.float32)

    all_stages: dict[str, Callable[[MapState, Measurement], Any]] = {
        "point transform, gates, noise": transform,
        "recenter": lambda state, m: grid.recenter(state, m, g),
        "age": lambda state, m: aging.age(state, m, cfg.aging),
        "drift compensation": lambda state, m: drift_stage(state, m),
        "height update": lambda state, m: fusion.fuse(state, m, g, cfg.fusion),
        "ray casting": lambda state, m: raycast.clear_seen_through(state, m, g, cfg.raycast),
        "overlap clearance": lambda state, m: overlap.clear_other_floors(state, m, g, cfg.overlap),
        "normals and traversability": lambda state, m: pipeline.rate_surface(state, cfg),
    }

    def drift_stage(state: MapState, m: Measurement) -> MapState:
        return drift.compensate(state, m, g, cfg.drift)

    inputs = (drive.emap.state, transform(drive.emap.state, None))  # type: ignore[arg-type]
    times = {name: stage_time(all_stages[name], inputs, seconds) for name in track(all_stages)}
    return {"points": BPEARL, "stages": times}


def stage_time(stage: Callable[[MapState, Measurement], Any], inputs: Any, seconds: float) -> dict[str, float]:
    """Compile a stage on its own and time it; masks come and go as bytes, as in the whole update."""

    def run(values: Any) -> Any:
        masks = tree_map(lambda t: as_mask(t) if isinstance(t, Tensor) and t.dtype == torch.uint8 else t, values)
        return mask_bytes(stage(*masks))

    fresh_compiler()
    compiled = torch.compile(run, fullgraph=True, options=pipeline.compiler_options())
    values = mask_bytes(inputs)
    with torch.no_grad():
        compiled(values)
        return meter.milliseconds(lambda: compiled(values), seconds)


def mask_bytes(values: Any) -> Any:
    """Return the values with their masks as bytes."""
    return tree_map(lambda t: as_bytes(t) if isinstance(t, Tensor) and t.dtype == torch.bool else t, values)


def robots(seconds: float, track: Track) -> dict[str, Any]:
    """Time an update, and record its memory, against the number of robots."""
    cfg = full_config(64)
    needed = meter.needed_memory(cfg, MANY_POINTS)
    moved = meter.needed_traffic(cfg, MANY_POINTS)
    rows = []
    for count in track(ROBOTS):
        fresh_compiler()
        drive = Drive(cfg, MANY_POINTS, robots=count, scans=4)
        drive.warm_up()
        time = meter.milliseconds(drive, seconds)
        temporary = meter.peak_bytes(drive) / count
        kept = meter.state_bytes(cfg) + 12 * MANY_POINTS
        memory = {"temporary_bytes_per_robot": temporary, "bytes_per_robot": kept + temporary}
        rate = {"gigabytes_per_second": moved * count / time["median"] / 1e6}
        rows.append({"robots": count} | time | {"ms_per_robot": time["median"] / count} | memory | rate)
    return {"cells": 64, "points": MANY_POINTS, "needed_bytes_per_robot": needed, "rows": rows}


def cells(seconds: float, track: Track) -> dict[str, Any]:
    """Time one robot's update against the number of cells."""
    rows = []
    for side in track(CELLS):
        fresh_compiler()
        drive = Drive(full_config(side), BPEARL, reach=5.0)
        drive.watch(8)
        rows.append({"cells": side**2} | meter.milliseconds(drive, seconds))
    sizes, times = [row["cells"] for row in rows], [row["median"] for row in rows]
    return {"points": BPEARL, "rows": rows, "exponent": meter.exponent(sizes[1:], times[1:])}


def rays(seconds: float, track: Track) -> dict[str, Any]:
    """Time one robot's update against the length of its rays, within the window and far beyond it."""
    rows = []
    for length in track(RAYS):
        drive = Drive(full_config(), BPEARL, scans=4, reach=length)
        # The farthest hit alone grows: all points on a ring just inside it.
        for cloud in drive.clouds:
            xy = cloud[..., :2]
            xy *= length * torch.empty_like(cloud[..., :1]).uniform_(0.9, 1.0) / xy.norm(dim=-1, keepdim=True)
        drive.watch(8)
        rows.append({"metres": length} | meter.milliseconds(drive, seconds))
    sizes, times = [row["metres"] for row in rows], [row["median"] for row in rows]
    return {"points": BPEARL, "rows": rows, "exponent": meter.exponent(sizes, times)}


def parts(seconds: float, track: Track) -> dict[str, Any]:
    """Time reset, recenter and sampling beside the update that they go with."""
    rows = []
    for count, cfg, n in track([(1, full_config(), BPEARL), (256, full_config(64), MANY_POINTS)]):
        fresh_compiler()
        drive = Drive(cfg, n, robots=count, scans=4)
        drive.warm_up()
        emap = drive.emap
        update = meter.milliseconds(drive, seconds)
        times = {"recenter": recenter_time(drive, seconds)}
        scan = emap.center[:, None, :2] + torch.rand(count, 187, 2) - 0.5
        some, mask = torch.arange(0, count, 2), torch.arange(count) % 2 == 0
        times["sample 187"] = meter.milliseconds(lambda e=emap, xy=scan: e.sample(xy), seconds)
        times["reset"] = meter.milliseconds(lambda e=emap: e.reset(), seconds)
        times["reset ids"] = meter.milliseconds(lambda e=emap, ids=some: e.reset(ids), seconds)
        times["reset mask"] = meter.milliseconds(lambda e=emap, m=mask: e.reset(mask=m), seconds)
        shares = {name: time["median"] / update["median"] for name, time in times.items()}
        rows.append({"robots": count, "update": update} | times | {"shares": shares})
    return {"rows": rows}


def recenter_time(drive: Drive, seconds: float) -> dict[str, float]:
    """Time moving the windows to and fro by a cell, in the parts that an update has."""
    emap, g = drive.emap, drive.emap.cfg.grid
    runs = []
    fresh_compiler()

    def recenter(values: Any) -> Any:
        state, m = tree_map(lambda t: as_mask(t) if t is not None and t.dtype == torch.uint8 else t, values)
        return mask_bytes(grid.recenter(state, m, g))

    compiled = torch.compile(recenter, fullgraph=True, options=pipeline.compiler_options())
    points, T = drive.next_scan()
    ahead = T.clone()
    ahead[:, 0, 3] = emap.center[:, 0] + 0.04
    measurement = emap.measure(points, T, ahead, drive.dt)
    for envs in emap._chunks():
        state = map_layers(lambda layer, envs=envs: layer[envs], emap.state)
        m = Measurement(*(None if value is None else value[envs] for value in measurement))
        runs.append(mask_bytes((state, m)))

    def all_parts() -> None:
        for values in runs:
            compiled(values)

    with torch.no_grad():
        all_parts()
        return meter.milliseconds(all_parts, seconds)


IMPORT = "import time, torch; t = time.perf_counter(); import torchelev; print(time.perf_counter() - t)"
FIRST = """
import time, torch
from benchmarks.workload import BPEARL, Drive, full_config
torch.set_num_threads({threads})
drive = Drive(full_config(), BPEARL, scans=1)
t = time.perf_counter()
drive()
print(time.perf_counter() - t)
"""


def start(seconds: float, track: Track) -> dict[str, Any]:
    """Time importing, the first compiled update without and with the compiler's cache, each in its own process."""
    imports = [float(run_python(IMPORT)[0]) for _ in track(range(5))]
    first = FIRST.format(threads=torch.get_num_threads())
    with tempfile.TemporaryDirectory() as cache:
        (cold, said), (cached, _) = (run_python(first, TORCHINDUCTOR_CACHE_DIR=cache) for _ in track(range(2)))
    result = {"import_seconds": statistics.median(imports), "first_update_seconds": float(cold)}
    return result | {"cached_first_update_seconds": float(cached), "announced": said.count("compiling the update")}


def run_python(code: str, **environment: str) -> tuple[str, str]:
    """Run code in a new process; return what it prints and what it says on stderr."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ | environment
    )
    return done.stdout.strip(), done.stderr


SECTIONS = {f.__name__: f for f in (points, stages, robots, cells, rays, parts, start)}
