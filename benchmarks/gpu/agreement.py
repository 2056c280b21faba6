"""Whether a GPU's maps equal the CPU's, whether runs repeat, and whether the host waits for the GPU."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from benchmarks.speed.common.workload import Drive, full_config
from torchelev import ElevationMap


def compare(first: ElevationMap, second: ElevationMap) -> dict[str, float]:
    """Compare which cells two maps know, and the heights of the cells that both know [m]."""
    known, other_known = (emap.state.validity.cpu() for emap in (first, second))
    elevation, other_elevation = (emap.state.elevation.cpu() for emap in (first, second))
    difference = (elevation - other_elevation)[known & other_known].abs().sort().values
    return {
        "cells_known_by_one_alone": float((known != other_known).float().mean()),
        "median_difference_m": float(difference[len(difference) // 2]),
        "difference_m_999": float(difference[int(0.999 * (len(difference) - 1))]),
        "largest_difference_m": float(difference[-1]),
    }


def driven(device: str, compiled: bool, robots: int = 4, updates: int = 20) -> ElevationMap:
    """Return the maps of a few robots after `updates` updates."""
    drive = Drive(full_config(64), 2048, robots=robots, device=device, compiled=compiled)
    for _ in range(updates):
        drive()
    return drive.emap


def correctness(device: str) -> dict[str, Any]:
    """Compare the GPU's maps with the CPU's, and with those of a second run."""
    on_cpu = driven("cpu", compiled=False)
    result: dict[str, Any] = {"eager": compare(driven(device, False), on_cpu)}
    result["compiled"] = compare(driven(device, True), on_cpu)
    result["run to run"] = compare(driven(device, False), driven(device, False))
    with _deterministic():
        result["run to run, deterministic"] = compare(driven(device, False), driven(device, False))
    return result


@contextmanager
def _deterministic() -> Iterator[None]:
    """Use deterministic algorithms within the block."""
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(False)


def host_never_waits(drive: Drive) -> dict[str, bool]:
    """Update, sample and reset; raise RuntimeError if the host waits for the GPU."""
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
