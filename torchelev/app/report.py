"""What is said and drawn of a map that was made from a recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torchelev.io.mapping import MappingRun

if TYPE_CHECKING:
    from torchelev.viz.plot import Panel


def summary(run: MappingRun, num_scans: int) -> list[str]:
    """Lines on scans, window, coverage, points and time of a run over `num_scans` scans."""
    grid = run.emap.cfg.grid
    x, y = run.emap.center[0, :2].tolist()
    coverage = 100 * float(run.emap.layer("validity")[0].mean())
    share = 100 * run.counts["points_used"] / max(run.num_points, 1)
    rejected = {k.removeprefix("rejected_"): n for k, n in run.counts.items() if k.startswith("rejected_") and n}
    parts = ", ".join(f"{name} {n:,}" for name, n in sorted(rejected.items(), key=lambda item: -item[1]))
    return [
        f"scans     {run.num_scans} of {num_scans}, {run.num_points:,} points",
        f"window    {grid.length_x:g} x {grid.length_y:g} m, cells of {grid.resolution:g} m, around ({x:.2f}, {y:.2f})",
        f"coverage  {coverage:.1f} % of the window's cells",
        f"points    {run.counts['points_used']:,} used ({share:.1f} %); not used: {parts or 'none'}",
        f"time      {np.median(run.update_ms):.1f} ms per scan (median; slowest {max(run.update_ms):.1f} ms)",
    ]


def hints(run: MappingRun, fixed: bool, knows_base: bool) -> list[str]:
    """Lines on options that were not given and that this recording calls for."""
    grid, lines = run.emap.cfg.grid, []
    reach = float(np.ptp(np.array(run.sensor_xy), axis=0).max())
    if not fixed and reach > min(grid.length_x, grid.length_y):
        size = math.ceil(reach + grid.length_x)
        lines.append(f"note      the path spans {reach:.0f} m; this is its last part, --fixed --size {size} keeps all")
    if not knows_base:
        lines.append("note      overlap clearance is off: it needs --sensor-height or --extrinsics")
    return lines


def map_panels(layers: dict[str, NDArray], filters: Sequence[str] = ()) -> list[Panel]:
    """The four layers (H, W) that tell most, and those of filters.

    Elevation and upper bound share their colours, so that they compare.
    """
    from torchelev.viz.plot import Panel

    elevation, traversability = layers["elevation"], layers["traversability"]
    known = elevation[np.isfinite(elevation)]
    low, high = (float(v) for v in np.percentile(known, [1, 99])) if known.size else (None, None)
    return [
        Panel(title="elevation", values=elevation, unit="m", vmin=low, vmax=high),
        Panel(title="standard deviation", values=np.sqrt(layers["variance"]), unit="m", cmap="magma", vmin=0.0),
        Panel(title="traversability", values=traversability, unit="0 to 1", cmap="RdYlGn", vmin=0.0, vmax=1.0),
        Panel(title="upper bound", values=layers["upper_bound"], unit="m", vmin=low, vmax=high),
        *(Panel(title=name, values=layers[name]) for name in filters),
    ]
