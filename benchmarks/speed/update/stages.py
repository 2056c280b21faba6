"""Time of the stages of an update, and of the calls beside it: recenter, sample, reset."""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import partial
from typing import Any

import torch

from benchmarks.speed.common import meter
from benchmarks.speed.common.meter import progress
from benchmarks.speed.common.workload import BPEARL, MANY_POINTS, Drive, full_config
from torchelev import pipeline
from torchelev.inputs.update_inputs import Inputs
from torchelev.kernels.cpu_update import as_inputs, compiled_stages
from torchelev.state import map_layers


def stages(seconds: float) -> dict[str, Any]:
    """Time each stage of a compiled update after `measure`, whose time is taken off (paper, Table I)."""
    drive = Drive(full_config(), BPEARL)
    drive.warm_up()
    names = ["measure", *(stage.name for stage in pipeline.STAGES)]
    runs: dict[str, Callable[[], Any]] = {name: _alone(drive, name) for name in names}
    times = meter.interleaved(runs | {"the whole update": drive}, seconds)
    for name in names[1:]:
        less = {key: max(0.0, times[name][key] - times["measure"][key]) for key in ("median", "min")}
        times[name] = times[name] | less
    return {"points": BPEARL, "stages": times}


def _alone(drive: Drive, name: str) -> Callable[[], None]:
    """Return what runs a stage after `measure`, on a copy of the maps that it changes again and again."""
    emap = drive.emap
    cloud, T = drive.next_scan()
    values = Inputs(cloud[:, None], T[:, None], T, drive.dt, None, None)
    inputs = as_inputs(values._asdict() | {"own": None})
    state = map_layers(torch.clone, emap.state)
    run = compiled_stages(pipeline.register_stages(emap.cfg)).run
    order = ("measure",) if name == "measure" else ("measure", name)
    return partial(run, (*state[:-1], *state.statistics), inputs, order)


def parts(seconds: float) -> dict[str, Any]:
    """Time recenter, sample and reset, and their fractions of an update."""
    rows = []
    for count, cfg, n in progress([(1, full_config(), BPEARL), (256, full_config(64), MANY_POINTS)], "parts"):
        drive = Drive(cfg, n, robots=count, scans=4)
        drive.warm_up()
        emap, other = drive.emap, copy.deepcopy(drive.emap)
        scan = emap.center[:, None, :2] + torch.rand(count, 187, 2) - 0.5
        ids, mask = torch.arange(0, count, 2), torch.arange(count) % 2 == 0
        runs: dict[str, Callable[[], Any]] = {
            "update": drive,
            "recenter": _alone(drive, "recenter"),
            "sample 187": partial(emap.sample, scan),
            "reset": other.reset,
            "reset ids": partial(other.reset, ids),
            "reset mask": partial(other.reset, mask=mask),
        }
        times = meter.interleaved(runs, seconds)
        fractions = {name: times[name]["median"] / times["update"]["median"] for name in runs if name != "update"}
        rows.append({"robots": count} | times | {"shares": fractions})
    return {"rows": rows}
