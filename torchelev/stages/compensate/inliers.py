"""Drift compensation by the inliers of the averaged fusion's gate."""

from __future__ import annotations

import torch

from torchelev.grid import GridConfig
from torchelev.ops.masks import count
from torchelev.stages.cells import cells_of
from torchelev.stages.compensate.config import DriftConfig, InlierConfig
from torchelev.stages.pose_error import share_pose_error
from torchelev.state import MapState, Measurement, tally


def compensate_by_inliers(
    state: MapState,
    m: Measurement,
    grid: GridConfig,
    cfg: DriftConfig,
    inliers: InlierConfig,
    min_traversability: float,
    max_variance: float,
) -> MapState:
    """Add a share of the mean height error to all elevations; upper bounds stay.

    h <- h + gain * mean(z - h) over the points of known cells with |z - h| < gate_per_variance * sigma_m^2,
    sigma_m^2 < max_variance, and a traversability above `min_traversability`, if that is positive. No correction if
    there are fewer than `min_points`, or |mean| > max_drift. No variance grows beyond `max_variance` [m^2].
    """
    cells = cells_of(state, m, grid)
    suits = state.validity & (state.variance < cfg.max_variance)
    if min_traversability > 0:
        suits = suits & (state.traversability > min_traversability)
    h, variance, suits = cells.take(state.elevation, state.variance, suits)
    error = m.points[..., 2] - h
    counts = cells.inside & suits & (error.abs() < inliers.gate_per_variance * variance)
    number = count(counts)
    mean = (torch.where(counts, error, 0.0).sum(1, dtype=torch.float64) / number.clamp(min=1)).to(error.dtype)
    applies = (number >= cfg.min_points) & (mean.abs() <= cfg.max_drift)
    if m.moving is not None:
        applies = applies & m.moving
    correction = torch.where(applies, cfg.gain * mean, 0.0)
    state = state._replace(elevation=state.elevation + correction[:, None, None] * state.validity)
    state = share_pose_error(state, m, applies, max_variance)
    return tally(state, drift_points=number, drift_error=mean, drift_correction=correction)
