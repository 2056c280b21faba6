"""Runs a recording through a peer, and scores it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.ndimage import maximum_filter, minimum_filter

from benchmarks.peers.peer import Array
from benchmarks.peers.process import About, Process
from benchmarks.peers.program import Program
from benchmarks.peers.recordings import Recording
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.pipeline import rate

STEP = 0.08  # [m] within a cell's neighbours, from which on it is a cell at a step
STEEP = 0.2  # [m] the critical step of the rating's default
SAFE = 0.5  # rating from which on ground counts as safe
CLOSE = 0.05  # [m] error of a cell that has caught up
CAUGHT_UP = 0.9  # share of the changed cells
GHOST = 0.1  # [m] error of a cell where something still stands that left


def run(peer: About, python: str, recording: Recording) -> dict[str, Any]:
    """Give a peer all scans of a recording; return its scores."""
    process = Program(peer, recording.setup) if peer.program else Process(peer, python, recording.setup)
    times, caught = [], {}
    try:
        for scan, frame in enumerate(recording.frames):
            times.append(process.update(frame))
            if scan in recording.reads or frame is recording.frames[-1]:
                height, std, memory = process.ground()
                caught[scan] = _share_close(height, recording, scan)
        return _speed(times) | {"memory_mb": memory / 1e6} | _accuracy(height, std, recording) | _changes(
            caught, height, recording
        )  # fmt: skip
    finally:
        process.close()


def _speed(times: list[tuple[float, float]]) -> dict[str, float]:
    """Return latency [ms] and CPU time [ms] of a scan; the first one warms up."""
    wall, cpu = 1e3 * np.array(times[1:] or times).T
    return {"p50_ms": float(np.median(wall)), "p99_ms": float(np.quantile(wall, 0.99)), "cpu_ms": float(cpu.mean())}


def _accuracy(height: Array, std: Array | None, recording: Recording) -> dict[str, float]:
    """Return errors [m], coverage and honesty of the last reading."""
    true = recording.truth(len(recording.frames) - 1)
    counts = recording.seen & np.isfinite(true)
    known = counts & np.isfinite(height)
    if not known.any():
        return {"coverage": 0.0}
    error = height[known] - true[known]
    at_step = (_range(true, 3) > STEP)[known]
    result = {
        "rmse": float(np.sqrt(np.mean(error**2))),
        "bias": float(np.median(error)),
        "coverage": float(known.sum() / counts.sum()),
    }
    if at_step.any():
        result["rmse_at_steps"] = float(np.sqrt(np.mean(error[at_step] ** 2)))
    if std is not None:
        result["within_2_std"] = float(np.mean(np.abs(error) <= 2 * std[known]))
    reach = 2 * round(0.1 / recording.setup.resolution) + 1
    is_steep = known & (_range(true, reach) >= STEEP)
    if is_steep.any():
        result["steep_rated_safe"] = float(np.mean((_rate(height, recording) >= SAFE)[is_steep]))
    return result


def _range(true: Array, width: int) -> Array:
    """Return highest less lowest known ground within a square of cells around each [m]."""
    known = np.isfinite(true)
    high = maximum_filter(np.where(known, true, -np.inf), width, mode="nearest")
    return high - minimum_filter(np.where(known, true, np.inf), width, mode="nearest")  # type: ignore[no-any-return]


def _rate(height: Array, recording: Recording) -> Array:
    """Return the analytic rating of a ground, the same for all peers."""
    size = recording.setup.resolution
    length_x, length_y = (size * n for n in recording.setup.cells)
    cfg = ElevationMapConfig(grid=GridConfig(resolution=size, length_x=length_x, length_y=length_y))
    ground = torch.from_numpy(height)[None].float()
    state = ElevationMap(cfg).state._replace(elevation=ground.nan_to_num(0.0), validity=ground.isfinite())
    return rate(state, cfg).traversability[0].numpy()  # type: ignore[no-any-return]


def _share_close(height: Array, recording: Recording, scan: int) -> float | None:
    """Return the share of the changed cells that are close to the present ground."""
    if recording.changed is None:
        return None
    counts = recording.changed & recording.seen
    error = np.abs(height - recording.truth(scan))[counts]
    return float(np.mean(error < CLOSE))


def _changes(caught: dict[int, float | None], height: Array, recording: Recording) -> dict[str, Any]:
    """Return after how many scans a peer has caught up with each event, None for never, and its share of ghosts."""
    if recording.changed is None:
        return {}
    ends = [*recording.events[1:], len(recording.frames)]
    reaction: list[int | None] = []
    for event, end in zip(recording.events, ends, strict=True):
        later = [scan for scan, share in caught.items() if event <= scan < end and (share or 0.0) >= CAUGHT_UP]
        reaction.append(later[0] - event if later else None)
    error = height - recording.truth(len(recording.frames) - 1)
    ghosts = np.mean((error > GHOST)[recording.changed])
    return {"reaction_scans": reaction, "ghosts": float(ghosts)}
