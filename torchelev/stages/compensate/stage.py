"""Height drift: the estimated sensor height wanders, so the map is moved to meet the newest scan."""

from __future__ import annotations

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.masks import NOWHERE, count
from torchelev.stages.cells import cells_of, center_offsets
from torchelev.stages.compensate.config import DriftConfig
from torchelev.stages.compensate.inliers import compensate_by_inliers
from torchelev.stages.disagreement.stage import compare_scans, compare_sensors
from torchelev.stages.pose_error import share_pose_error
from torchelev.state import MapState, Measurement, tally


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Average values (B, M) where the mask is true; 0 where it is nowhere."""
    # In float64: the compiler would put float32 sums of more than 4,096 points into a graph of their own.
    total = (values * mask).sum(1, dtype=torch.float64)
    return (total / count(mask).clamp(min=1)).to(values.dtype)


def compensate(
    state: MapState,
    m: Measurement,
    grid: GridConfig,
    cfg: DriftConfig | None,
    min_traversability: float,
    max_variance: float,
) -> MapState:
    """Add the mean height error over flat, certain cells to elevation and upper bound (paper, Sec. II-D).

        e = (1 / n) * sum (p_z - h),    h <- h + gain * e

    with h the height of the cell's plane below the point. The sum covers the points whose cell is known, certain and
    rated at least `min_traversability`, with |p_z - h| <= max_error, and then those within `gate` standard deviations
    of their mean. No correction if n < min_points or |e| > max_drift, or without `cfg`. Notes by how much scans, or the
    sensors of one, disagree. No variance grows beyond `max_variance` [m^2].
    """
    if cfg is not None and cfg.inliers is not None:
        return compensate_by_inliers(state, m, grid, cfg, cfg.inliers, min_traversability, max_variance)
    if m.origin.shape[1] > 1:
        state = tally(state, disagreement=compare_sensors(state, m, grid))
    if cfg is None:
        return share_pose_error(state, m, torch.zeros_like(m.dt, dtype=torch.bool), max_variance)
    cells = cells_of(state, m, grid)
    px, py, pz = m.points.unbind(-1)
    suits = state.validity & (state.traversability >= min_traversability) & (state.variance <= cfg.max_variance)
    # On a slope the height within a cell depends on where in the cell the point lies.
    x, y = center_offsets(state, m, grid)
    gx, gy = state.gradient_x, state.gradient_y
    at_origin = state.elevation - gx * x - gy * y
    # Unsuitable cells get a height that no point is near.
    ground, gx, gy = cells.take(at_origin + NOWHERE * ~suits, gx, gy)
    error = pz - (ground + gx * px + gy * py)  # read by every sum below
    counts = cells.inside & (error.abs() <= cfg.max_error)
    mean = masked_mean(error, counts)
    noise = m.variance if m.noise is None else m.noise
    # Again around the mean: the foot of a wall that was not seen before stands on ground that looks flat.
    counts = counts & ((error - mean[:, None]).square() <= cfg.gate**2 * (noise + cfg.relief**2))
    number, mean = count(counts), masked_mean(error, counts)
    applies = (number >= cfg.min_points) & (mean.abs() <= cfg.max_drift)
    if m.moving is not None:
        applies = applies & m.moving
    correction = torch.where(applies, cfg.gain * mean, 0.0)
    shift = correction[:, None, None]
    if m.origin.shape[1] == 1:
        of_mean = masked_mean(noise + cfg.relief**2, counts) / number.clamp(min=1)
        state = tally(state, disagreement=compare_scans(state, correction, of_mean))
    state = state._replace(
        elevation=state.elevation + shift * state.validity,
        challenger=state.challenger + shift.detach() * (state.challenger_support > 0),
        upper_bound=state.upper_bound + shift * state.bounded,
    )
    state = share_pose_error(state, m, applies, max_variance)
    return tally(state, drift_points=number, drift_error=mean, drift_correction=correction)
