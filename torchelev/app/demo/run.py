"""The demo: a simulated robot walks a course with a depth camera; its map is drawn beside the ground truth.

Run ``make demo`` or ``torchelev demo``. Needs ``torchelev[io]``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from torchelev.app.demo.picture import draw
from torchelev.app.demo.walk import CAMERA, GRID, DemoScan, DemoWalk
from torchelev.elevation_map import ElevationMap
from torchelev.files.output_files import require_writable
from torchelev.sim import DepthCamera, Scene, steps

_WARM_UP = 3  # updates that the median time leaves out


@dataclass(frozen=True, kw_only=True)
class DemoResult:
    """Errors of the final map over its known cells, and the speed of updates."""

    rmse: float  #: [m]
    rmse_off_steps: float  #: [m] without cells at steps
    p95: float  #: [m] 95th percentile of the absolute error
    coverage: float  #: known fraction of the cells that were hit
    ms_per_update: float  #: [ms] median
    updates: int  #: number of scans fused

    @property
    def accuracy(self) -> str:
        """The errors as a line of text."""
        return (
            f"RMSE {100 * self.rmse:.2f} cm ({100 * self.rmse_off_steps:.2f} cm away from steps), "
            f"p95 {100 * self.p95:.2f} cm, coverage {100 * self.coverage:.1f} % of the cells seen"
        )

    def __str__(self) -> str:
        return f"{self.accuracy}, {self.ms_per_update:.1f} ms per update"


class _HitCells:
    """Cells that were hit since they entered the window: those that the map can know."""

    def __init__(self, resolution: float, reach: float = 12.0) -> None:
        self.resolution = resolution
        self.half = round(reach / resolution)
        self.cells = torch.zeros(2 * self.half, 2 * self.half, dtype=torch.bool)

    def add(self, scan: DemoScan, window: Tensor) -> None:
        """Add the cells that a scan hit; drop those outside the window, given by its cell centres (H, W, 2) [m]."""
        T = scan.T_map_sensor
        points = scan.points[scan.points.isfinite().all(-1)].double()
        self.cells[self._index((points @ T[:3, :3].T + T[:3, 3])[:, :2])] = True
        outside = self.cells.clone()
        outside[self._index(window)] = False
        self.cells &= ~outside

    def at(self, xy: Tensor) -> Tensor:
        """Return which of the cells with centres (H, W, 2) [m] were hit, (H, W) bool."""
        return self.cells[self._index(xy)]

    def _index(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        cell = (torch.floor(xy / self.resolution).long() + self.half).clamp(0, 2 * self.half - 1)
        return cell[..., 0], cell[..., 1]


def run_demo(
    out: str | Path = "demo.png", seconds: float | None = None, progress: bool = True, camera: DepthCamera = CAMERA
) -> DemoResult:
    """Walk the course, map it and draw the result.

    Args:
        out: the picture to write.
        seconds: simulated time [s] to walk; None: the whole course, about 30 s.
        progress: show a progress bar.
        camera: what the robot sees with.

    Returns:
        The errors of the map and the speed of updates.

    Raises:
        WriteError: the picture cannot be written; raised before the walk, as is ValueError.
        ValueError: the suffix is not a picture's, or the time is not positive.
    """
    from torchelev.viz.style import require_picture

    require_picture(out)
    require_writable(out)
    demo, hit = DemoWalk(seconds, camera), _HitCells(GRID.resolution)
    for scan in tqdm(demo, desc="walking and mapping", unit="scan", disable=not progress):
        hit.add(scan, demo.emap.cell_centers()[0])
    end = float(demo.path.times[len(demo) - 1])
    result = _assess(demo.emap, demo.scene, hit, demo.update_ms, end)
    truth = demo.scene.truth(demo.emap.cell_centers()[0], end)
    title = f"A simulated walk: {result.updates} scans in one map\n{result.accuracy}"
    draw(out, demo.emap, truth, demo.path.T_map_base[: len(demo), :2, 3], title)
    return result


def _assess(emap: ElevationMap, scene: Scene, hit: _HitCells, update_ms: list[float], t: float) -> DemoResult:
    """Compare the map with the ground truth at time t [s]."""
    xy, elevation = emap.cell_centers()[0], emap.layer("elevation")[0].double()
    error = (elevation - scene.truth(xy, t)).abs()
    is_known, is_hit = error.isfinite(), hit.at(xy)
    return DemoResult(
        rmse=float(error[is_known].square().mean().sqrt()),
        rmse_off_steps=float(error[is_known & ~find_steps(scene, xy, t)].square().mean().sqrt()),
        p95=float(error[is_known].quantile(0.95)),
        coverage=float((is_known & is_hit).sum() / is_hit.sum()),
        ms_per_update=float(torch.tensor(update_ms[_WARM_UP:] or update_ms).median()),
        updates=len(update_ms),
    )


def find_steps(scene: Scene, xy: Tensor, t: float) -> Tensor:
    """Find the cells, given by centres (H, W, 2) [m], in or next to which it rises by more than 5 cm, (H, W)."""
    return steps.find_steps(lambda places: scene.truth(places, t), xy, GRID.resolution, 0.05)
