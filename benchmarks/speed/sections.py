"""The sections of `benchmarks.speed.run`: each measures one question and returns what belongs into the JSON."""

from __future__ import annotations

import copy
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

from benchmarks.speed import meter
from benchmarks.speed.workload import BPEARL, MANY_POINTS, SENSORS, Drive, baseline_config, full_config
from torchelev import compiled_update as compilation
from torchelev import pipeline
from torchelev.ops import compiler
from torchelev.ops.storage import as_bytes, as_mask
from torchelev.stages import age as aging
from torchelev.stages import compensate as drift
from torchelev.stages import measure as sensor
from torchelev.stages import overlap, recenter
from torchelev.stages.fusion import fuse as fusion
from torchelev.stages.visibility import clean_up as raycast
from torchelev.state import MapState, Measurement, map_layers

POINTS = [1000, 3000, 6276, 15000, 43074, 100000, 200000, 407040]
ROBOTS = [1, 4, 16, 64, 256, 1024, 4096]
CELLS = [125, 250, 500, 1000]  # along each side
RAYS = [1.2, 1.7, 2.4, 3.4, 4.8, 6.8, 19.2, 38.4]  # [m] horizontal length of the longest; the window ends at 5
STEEPNESS = 0.5  # of rays that end above the exclusion ramp, however far
Track = Callable[[Iterable], Iterable]  # shows progress


def fresh_compiler() -> None:
    """Forget compiled updates: the one for a second number of robots would be made for any number."""
    torch._dynamo.reset()
    compilation.graphs_of.cache_clear()


def points(seconds: float, track: Track) -> dict[str, Any]:
    """Time one robot's update against the number of points: all stages, the paper's plain baseline, eager."""
    counters.clear()
    drives = {("full", n): Drive(full_config(), n) for n in POINTS}
    drives |= {("baseline", n): Drive(baseline_config(), n) for n in POINTS}
    drives |= {("eager", n): Drive(full_config(), n, compiled=False) for n in sorted(row[1] for row in SENSORS)}
    for (kind, _), drive in track(drives.items()):
        drive.watch(8) if kind == "baseline" else drive.warm_up()
    times = meter.interleaved(drives, seconds)
    results: dict[str, Any] = {"full": [], "baseline": [], "eager": []}
    for (kind, n), drive in drives.items():
        moved = meter.needed_traffic(drive.emap.cfg, n)
        row = {"points": n} | times[kind, n] | {"necessary_bytes": moved}
        row["gigabytes_per_second"] = moved / row["median"] / 1e6
        results[kind].append(row | {"largest_statistics": drive.seen})
    sizes, medians = [row["points"] for row in results["full"]], [row["median"] for row in results["full"]]
    results["graphs"] = counters["stats"]["unique_graphs"] - len(compilation.Graphs._fields)  # of these, the baseline's
    results["exponent"] = meter.exponent(sizes, medians)
    many = sizes.index(BPEARL)
    results["exponent_from_43074"] = meter.exponent(sizes[many:], medians[many:])
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
        "recenter": lambda state, m: recenter.recenter(state, m, g),
        "age": lambda state, m: aging.age(state, m, cfg.aging),
        "drift compensation": lambda state, m: drift.compensate(state, m, g, cfg.drift, cfg.drift_gate),
        "height update": lambda state, m: fusion.fuse(state, m, g, cfg.fusion, has_rays=True),
        "ray casting": lambda state, m: raycast.clear_seen_through(state, m, g, cfg.raycast),
        "overlap clearance": lambda state, m: overlap.clear_other_floors(state, m, g, cfg.overlap),
        "normals and traversability": lambda state, m: pipeline.rate_surface(state, cfg),
    }

    inputs = (drive.emap.state, transform(drive.emap.state, None))  # type: ignore[arg-type]
    runs = {name: compiled_alone(all_stages[name], [inputs]) for name in track(all_stages)}
    whole = Drive(cfg, BPEARL)
    whole.warm_up()
    return {"points": BPEARL, "stages": meter.interleaved(runs | {"the whole update": whole}, seconds)}


def compiled_alone(stage: Callable[[MapState, Measurement], Any], inputs: list[Any]) -> Callable[[], None]:
    """Compile a stage on its own, for one input after the other; masks come and go as bytes, as in the whole update."""

    def on_bytes(values: Any) -> Any:
        return mask_bytes(stage(*(compilation.with_masks(value, as_mask) for value in values)))

    compiled = compiler.compiled(on_bytes)
    values = [tuple(compilation.with_masks(part, as_bytes) for part in value) for value in inputs]

    def run() -> None:
        with torch.no_grad():
            for value in values:
                compiled(value)

    run()
    return run


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
    drives = {side**2: Drive(full_config(side), BPEARL, reach=5.0) for side in CELLS}
    for drive in track(drives.values()):
        drive.watch(8)
    times = meter.interleaved(drives, seconds)
    rows = [{"cells": count} | time for count, time in times.items()]
    exponent = meter.exponent(CELLS[1:], [row["median"] for row in rows[1:]]) / 2  # cells are sides squared
    return {"points": BPEARL, "rows": rows, "exponent": exponent}


def rays(seconds: float, track: Track) -> dict[str, Any]:
    """Time one robot's update against the length of half of its rays; the others measure the ground nearby.

    Those of that half rise above the exclusion ramp, all at one slope: they give no heights, so that what they take is
    casting alone. One that leaves the polar table has no more to do, so the exponent is of the lengths within it.
    """
    cfg = full_config()
    assert cfg.raycast
    within = raycast.PolarGrid.of(cfg.grid, cfg.raycast).ranges * cfg.grid.resolution
    drives = {length: Drive(cfg, BPEARL, scans=4, reach=RAYS[0]) for length in RAYS}
    for length, drive in track(drives.items()):
        generator = torch.Generator().manual_seed(0)
        for cloud in drive.clouds:
            far = cloud[:, ::2]
            reach = length * (0.9 + 0.1 * torch.rand(far[..., :1].shape, generator=generator))
            far[..., :2] *= reach / far[..., :2].norm(dim=-1, keepdim=True)
            far[..., 2:] = STEEPNESS * reach
        drive.watch(8)
        work = {name: drive.seen[name] for name in ("points_used", "drift_points", "cells_bounded")}
        assert min(work.values()) > 0, f"rays of {length} m: nothing to do, {work}"
    times = meter.interleaved(drives, seconds)
    rows = [
        {"metres": length} | time | {"bounded": drives[length].seen["cells_bounded"]} for length, time in times.items()
    ]
    shorter = [row for row in rows if row["metres"] <= within]
    exponent = meter.exponent([row["metres"] for row in shorter], [row["median"] for row in shorter])
    return {"points": BPEARL, "rows": rows, "exponent": exponent}


def parts(seconds: float, track: Track) -> dict[str, Any]:
    """Time reset, recenter and sampling beside the update that they go with."""
    rows = []
    for count, cfg, n in track([(1, full_config(), BPEARL), (256, full_config(64), MANY_POINTS)]):
        drive = Drive(cfg, n, robots=count, scans=4)
        drive.warm_up()
        emap, other = drive.emap, copy.deepcopy(drive.emap)
        scan = emap.center[:, None, :2] + torch.rand(count, 187, 2) - 0.5
        ids, mask = torch.arange(0, count, 2), torch.arange(count) % 2 == 0
        runs = {
            "update": drive,
            "recenter": compiled_alone(lambda state, m, g=cfg.grid: recenter.recenter(state, m, g), chunks_of(drive)),
            "sample 187": lambda emap=emap, scan=scan: emap.sample(scan),
            "reset": other.reset,
            "reset ids": lambda other=other, ids=ids: other.reset(ids),
            "reset mask": lambda other=other, mask=mask: other.reset(mask=mask),
        }
        times = meter.interleaved(runs, seconds)
        shares = {name: times[name]["median"] / times["update"]["median"] for name in runs if name != "update"}
        rows.append({"robots": count} | times | {"shares": shares})
    return {"rows": rows}


def chunks_of(drive: Drive) -> list[tuple[MapState, Measurement]]:
    """Return states and measurements a cell ahead, in the parts that an update has."""
    emap = drive.emap
    points, T = drive.next_scan()
    ahead = T.clone()
    ahead[:, 0, 3] = emap.center[:, 0] + emap.cfg.grid.resolution
    measurement = emap.measure(points, T, ahead, drive.dt)
    state = map_layers(torch.clone, emap.state)
    return [
        (
            map_layers(lambda layer, envs=envs: layer[envs], state),
            Measurement(*(None if value is None else value[envs] for value in measurement)),
        )
        for envs in emap.chunks
    ]


IMPORT = "import time, torch; t = time.perf_counter(); import torchelev; print(time.perf_counter() - t)"
FIRST = """
import time, torch
from benchmarks.speed.workload import BPEARL, Drive, full_config
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
