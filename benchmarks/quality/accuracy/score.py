"""The score of one row: the map's height error, beside those of the per-cell mean and maximum."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks.quality.accuracy.recordings import GRID, SimulatedRun, corrupt, record
from torchelev import ElevationMap, ElevationMapConfig
from torchelev.sim.exact.scenes import Scene

_RADIUS = 2.5  # [m] around the robot's last position in which cells are scored


class _Cells(NamedTuple):
    """Statistics of the points in each cell of the window, (H, W) each."""

    mean: Tensor  #: [m]
    maximum: Tensor  #: [m]
    num_points: Tensor
    is_reliable: Tensor  #: holds more correct points than outliers


def _bin_points(emap: ElevationMap, recording: SimulatedRun, scans: list[Tensor]) -> _Cells:
    """Bin all points of a recording into the cells of the map's window."""
    in_map = torch.cat(
        [p.double() @ T[:3, :3].T + T[:3, 3] for p, T in zip(scans, recording.T_map_sensor, strict=True)]
    )
    outlier = torch.cat([(p - q).norm(dim=-1) > 0.1 for p, q in zip(scans, recording.clean, strict=True)])
    index, inside = _locate(emap, in_map)
    index, z, outlier = index[inside], in_map[inside, 2], outlier[inside]
    zeros = torch.zeros(GRID.num_cells, dtype=torch.float64)
    count = zeros.index_add(0, index, torch.ones_like(z))
    outliers = zeros.index_add(0, index, outlier.double())
    mean = zeros.index_add(0, index, z) / count
    maximum = torch.full_like(zeros, -torch.inf).scatter_reduce(0, index, z, "amax")
    shape = (GRID.height, GRID.width)
    return _Cells(*(t.view(shape) for t in (mean, maximum, count, count > 2 * outliers)))


def _locate(emap: ElevationMap, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the flat cell number of each map-frame point (M, 3), and which points lie in the window."""
    k = torch.floor(points[:, :2] / GRID.resolution) - emap.state.corner[0]
    inside = torch.isfinite(points).all(-1) & (k >= 0).all(-1) & (k < torch.tensor([GRID.height, GRID.width])).all(-1)
    k = torch.where(inside[:, None], k, 0).long()
    return k[:, 0] * GRID.width + k[:, 1], inside


def _build_map(recording: SimulatedRun, scans: list[Tensor], cfg: ElevationMapConfig | None) -> ElevationMap:
    """Map the scans of a recording, with the default configuration if `cfg` is None."""
    emap = ElevationMap(cfg or ElevationMapConfig(grid=GRID))
    for points, T_map_sensor, T_map_base in zip(scans, recording.T_map_sensor, recording.T_map_base, strict=True):
        emap.update(points[None], T_map_sensor[None], T_map_base[None], 0.1)
    return emap


@dataclass(frozen=True)
class Score:
    """One row of the table."""

    scene: str
    motion: str
    noise: str
    rmse: float  #: [mm] of the map
    rmse_mean: float  #: [mm] of the per-cell mean
    rmse_max: float  #: [mm] of the per-cell maximum
    ratio: float  #: rmse divided by rmse_mean, both at least 1 mm
    bias: float  #: [mm] mean error of the map
    coverage: float  #: fraction of the cells with points that the map knows
    wrong_5cm: float  #: fraction of cells more than 5 cm outside the true heights of their 3 x 3 neighborhood
    wrong_5cm_mean: float  #: the same for the per-cell mean


def score(name: str, motion: str, kind: str, cfg: ElevationMapConfig | None = None) -> Score:
    """Map one recording and compare the map, the mean and the maximum with the truth."""
    recording = record(name, motion)
    scans = corrupt(recording, kind)
    emap = _build_map(recording, scans, cfg)
    plain = _bin_points(emap, recording, scans)
    xy = emap.cell_centers()[0]
    truth = recording.scene.truth(xy)
    near = (xy - recording.T_map_base[-1, :2, 3]).norm(dim=-1) <= _RADIUS
    measured = near & (plain.num_points > 0)
    if kind == "outliers":
        measured &= plain.is_reliable
    elevation = emap.layer("elevation")[0].double()
    scored = measured & elevation.isfinite()
    errors = [(height - truth)[scored] * 1e3 for height in (elevation, plain.mean, plain.maximum)]
    rmse, rmse_mean, rmse_max = (error.square().mean().sqrt().item() for error in errors)
    low, high = _true_range(recording.scene, xy)
    excess = [(height - high).clamp(min=0) + (low - height).clamp(min=0) for height in (elevation, plain.mean)]
    wrong, wrong_mean = ((distance[scored] > 0.05).double().mean().item() for distance in excess)
    return Score(
        scene=name,
        motion=motion,
        noise=kind,
        rmse=rmse,
        rmse_mean=rmse_mean,
        rmse_max=rmse_max,
        ratio=max(rmse, 1.0) / max(rmse_mean, 1.0),
        bias=errors[0].mean().item(),
        coverage=(scored.sum() / measured.sum()).item(),
        wrong_5cm=wrong,
        wrong_5cm_mean=wrong_mean,
    )


def _true_range(scene: Scene, xy: Tensor) -> tuple[Tensor, Tensor]:
    """Return the lowest and highest true height of each 3 x 3 neighborhood, within which noise may move a point."""
    offsets = torch.linspace(-1.5, 1.5, 7, dtype=torch.float64) * GRID.resolution
    heights = torch.stack([scene.truth(xy + torch.stack([dx, dy])) for dx in offsets for dy in offsets])
    return heights.amin(0), heights.amax(0)


def meets(row: Score) -> bool:
    """Return whether a row meets its target."""
    good = row.coverage >= 0.995 and (row.scene != "flat" or row.noise == "outliers" or abs(row.bias) <= 1.0)
    if row.noise == "outliers":
        return good and row.ratio <= 0.85 and row.wrong_5cm <= 0.004
    return good and row.ratio <= 1.05
