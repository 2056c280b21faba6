"""What the stages of an update cost, and the calls beside it: recenter, sample, reset."""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from benchmarks.speed import meter
from benchmarks.speed.meter import progress
from benchmarks.speed.workload import BPEARL, MANY_POINTS, Drive, full_config
from torchelev import pipeline
from torchelev.compiled import compiler
from torchelev.compiled.update import with_masks
from torchelev.ops.storage import as_bytes, as_mask
from torchelev.stages import age, compensate, measure, recenter
from torchelev.stages.fusion import fuse
from torchelev.stages.overlap import clear
from torchelev.stages.visibility import clean_up
from torchelev.state import MapState, Measurement, map_layers

_Stage = Callable[[MapState, Measurement], Any]


def stages(seconds: float) -> dict[str, Any]:
    """Time each stage compiled on its own (paper, Table I).

    Their sum exceeds the time of the whole update, in which the compiler fuses stages.
    """
    cfg = full_config()
    drive = Drive(cfg, BPEARL, compiled=False)
    drive.warm_up()
    cloud, T = drive.next_scan()
    grid = cfg.grid
    assert cfg.drift and cfg.raycast and cfg.overlap and cfg.traversability

    def transform() -> Measurement:
        inputs = cloud[:, None], T[:, None], T, drive.dt, None, None, None
        return measure.measure(*inputs, grid, cfg.sensor, torch.float32)

    all_stages: dict[str, _Stage] = {
        "point transform, gates, noise": lambda state, m: transform(),
        "recenter": lambda state, m: recenter.recenter(state, m, grid),
        "age": lambda state, m: age.age(state, m, cfg.aging),
        "drift compensation": lambda state, m: compensate.compensate(state, m, grid, cfg.drift, cfg.drift_gate),
        "height update": lambda state, m: fuse.fuse(state, m, grid, cfg.fusion, has_rays=True),
        "ray casting": lambda state, m: clean_up.clear_seen_through(state, m, grid, cfg.raycast),
        "overlap clearance": lambda state, m: clear.clear_other_floors(state, m, grid, cfg.overlap),
        "normals and traversability": lambda state, m: pipeline.rate_surface(state, cfg),
    }
    inputs = [(drive.emap.state, transform())]
    runs: dict[str, Callable[[], Any]] = {
        name: _compiled_alone(stage, inputs) for name, stage in progress(all_stages.items(), "stages")
    }
    update = Drive(cfg, BPEARL)
    update.warm_up()
    times = meter.interleaved(runs | {"the whole update": update}, seconds)
    moved = {name: _traffic(stage, *inputs[0]) for name, stage in all_stages.items()}
    moved["the whole update"] = meter.needed_traffic(cfg, BPEARL)
    return {"points": BPEARL, "stages": {name: time | {"bytes": moved[name]} for name, time in times.items()}}


def parts(seconds: float) -> dict[str, Any]:
    """Time recenter, sample and reset, and their fractions of an update."""
    rows = []
    for count, cfg, n in progress([(1, full_config(), BPEARL), (256, full_config(64), MANY_POINTS)], "parts"):
        drive = Drive(cfg, n, robots=count, scans=4)
        drive.warm_up()
        emap, other = drive.emap, copy.deepcopy(drive.emap)
        scan = emap.center[:, None, :2] + torch.rand(count, 187, 2) - 0.5
        ids, mask = torch.arange(0, count, 2), torch.arange(count) % 2 == 0
        recenter_alone = partial(recenter.recenter, grid=cfg.grid)
        runs: dict[str, Callable[[], Any]] = {
            "update": drive,
            "recenter": _compiled_alone(recenter_alone, _chunked_inputs(drive)),
            "sample 187": partial(emap.sample, scan),
            "reset": other.reset,
            "reset ids": partial(other.reset, ids),
            "reset mask": partial(other.reset, mask=mask),
        }
        times = meter.interleaved(runs, seconds)
        fractions = {name: times[name]["median"] / times["update"]["median"] for name in runs if name != "update"}
        rows.append({"robots": count} | times | {"shares": fractions})
    return {"rows": rows}


def _compiled_alone(stage: _Stage, inputs: list[tuple[MapState, Measurement]]) -> Callable[[], None]:
    """Compile a stage on its own and call it with each input; masks are stored as bytes, as in the whole update."""

    def on_bytes(state: MapState, m: Measurement) -> Any:
        return _mask_bytes(stage(with_masks(state, as_mask), with_masks(m, as_mask)))

    compiled = compiler.compiled(on_bytes)
    stored = [(with_masks(state, as_bytes), with_masks(m, as_bytes)) for state, m in inputs]

    def run() -> None:
        with torch.no_grad():
            for state, m in stored:
                compiled(state, m)

    run()
    return run


def _traffic(stage: _Stage, state: MapState, m: Measurement) -> int:
    """Return how many bytes a stage reads and writes, each value once, without what it stores in between."""
    moved: list[int] = []

    def add_up(graph: torch.fx.GraphModule, _: Any) -> Callable[..., Any]:
        read = [node for node in graph.graph.find_nodes(op="placeholder") if node.users]
        written = set(graph.graph.output_node().args[0]) - set(read)  # type: ignore[arg-type]
        values = [node.meta.get("example_value") for node in (*read, *written)]
        moved.append(sum(value.nbytes for value in values if isinstance(value, Tensor)))
        return graph.forward

    torch._dynamo.reset()
    with torch.no_grad():
        torch.compile(lambda state, m: stage(state, m), fullgraph=True, backend=add_up)(state, m)
    return moved[0]


def _mask_bytes(values: Any) -> Any:
    """Return the values with their masks as bytes."""
    return tree_map(lambda t: as_bytes(t) if isinstance(t, Tensor) and t.dtype == torch.bool else t, values)


def _chunked_inputs(drive: Drive) -> list[tuple[MapState, Measurement]]:
    """Return the state and a measurement one cell ahead, in the chunks of environments that an update works on."""
    emap = drive.emap
    points, T = drive.next_scan()
    ahead = T.clone()
    ahead[:, 0, 3] = emap.center[:, 0] + emap.cfg.grid.resolution
    measurement = emap.measure(points, T, ahead, drive.dt)
    state = map_layers(torch.clone, emap.state)
    return [_select(state, measurement, envs) for envs in emap.chunks]


def _select(state: MapState, measurement: Measurement, envs: slice) -> tuple[MapState, Measurement]:
    chunk = (None if value is None else value[envs] for value in measurement)
    return map_layers(lambda layer: layer[envs], state), Measurement._make(chunk)
