"""What `torchelev map` prints and draws of a finished map."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from torchelev.io import MappingRun

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap

_MANY_OVERHANGS = 0.25  # share of the finite points
_MIN_USED = 0.01  # of the finite points; with fewer, the map does not show the recorded place


def summarize(run: MappingRun, num_scans: int) -> list[str]:
    """Return lines on scans, window, coverage, points and time; `num_scans` is the length of the recording."""
    grid = run.emap.cfg.grid
    x, y = run.emap.center[0, :2].tolist()
    size = f"{grid.length_x:g} x {grid.length_y:g} m, {grid.resolution:g} m cells"
    coverage = 100 * float(run.emap.layer("validity")[0].mean())
    used = run.counts["points_used"]
    used_percent = 100 * used / max(run.num_points, 1)
    rejected = {k.removeprefix("rejected_"): n for k, n in run.counts.items() if k.startswith("rejected_") and n}
    reasons = ", ".join(f"{name} {n:,}" for name, n in sorted(rejected.items(), key=lambda item: -item[1]))
    return [
        f"scans     {run.num_scans} of {num_scans}, {run.num_points:,} points",
        f"window    {size}, centred on ({x:.2f}, {y:.2f})",
        f"coverage  {coverage:.1f} % of the window's cells",
        *_describe_channels(run.emap),
        *_describe_levels(run.emap),
        f"points    {used:,} used ({used_percent:.1f} %); rejected: {reasons or 'none'}",
        f"time      {np.median(run.update_ms):.1f} ms per scan (median; slowest {max(run.update_ms):.1f} ms)",
    ]


def _describe_channels(emap: ElevationMap) -> Iterator[str]:
    """Yield for each channel in how many of the known cells it is known."""
    known = emap.layer("validity")[0] > 0
    for name in emap.cfg.channels if known.any() else ():
        share = float(emap.read_channel(name)[1][0][known].float().mean())
        yield f"channel   {name}: {100 * share:.1f} % of the known cells"


def _describe_levels(emap: ElevationMap) -> Iterator[str]:
    """Yield how much of the known ground lies below something, and the lowest clearance."""
    if emap.levels is None:
        return
    clearance, known = emap.layer("clearance")[0], emap.layer("validity")[0] > 0
    covered = clearance[clearance.isfinite()]
    share = 100 * len(covered) / max(1, int(known.sum()))
    lowest = f"; the lowest clearance is {float(covered.min()):.2f} m" if len(covered) else ""
    yield f"levels    {share:.1f} % of the known cells lie below a ceiling{lowest}"


def describe_emptiness(run: MappingRun) -> str | None:
    """Return why a map is nearly empty: it holds less than 1 % of the points, or no cell; else None."""
    counts = run.counts
    total, used = run.num_points - counts["rejected_invalid"], counts["points_used"]
    rejected = {name: n for name, n in counts.items() if name.startswith("rejected_") and n}
    reason = max(rejected, key=lambda name: rejected[name]).removeprefix("rejected_") if rejected else "no points"
    if total <= 0 or used < _MIN_USED * total:
        amount = "empty" if not used else "nearly empty"
        return f"the map is {amount}: {used:,} of {run.num_points:,} points were used, most were rejected as '{reason}'"
    if not float(run.emap.layer("validity").sum()):
        return f"the map is empty at the end, though {used:,} points were used: they were cleared, or left behind"
    return None


def suggest_options(run: MappingRun, fixed: bool, knows_base: bool) -> list[str]:
    """Return notes on options that were not given and would help with this recording."""
    grid, notes = run.emap.cfg.grid, []
    span = float(np.ptp(np.array(run.sensor_xy), axis=0).max())
    if not fixed and span > min(grid.length_x, grid.length_y):
        size = math.ceil(span + grid.length_x)
        notes.append(
            f"note      the path spans {span:.0f} m and the map shows its end; use --fixed --size {size} to keep it all"
        )
    if not knows_base:
        notes.append(
            "note      overlap clearance is off; give --extrinsics (or --sensor-height for a folder) to enable it"
        )
    overhang = run.counts["rejected_overhang"] / max(run.num_points - run.counts["rejected_invalid"], 1)
    if overhang > _MANY_OVERHANGS and run.emap.levels is None:
        notes.append(
            f"note      {100 * overhang:.0f} % of the points lie above the exclusion ramp, like walls and trees, and "
            "are not mapped; --levels 3 maps what hangs over the ground, sensor.exclusion of --config sets the ramp"
        )
    return notes
