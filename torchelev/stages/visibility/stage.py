"""Rays: a cell that stands above a ray is gone, and ground that no ray saw lies below the lowest one."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.masks import count
from torchelev.stages.visibility.accepted_rays import accepted_rays
from torchelev.stages.visibility.config import RaycastConfig
from torchelev.stages.visibility.lowest_rays import (
    RayBins,
    RayOverCell,
    View,
    bins_of,
    find_lowest_rays,
    lowest_slopes,
    view_from,
)
from torchelev.stages.visibility.polar_table import PolarGrid
from torchelev.stages.visibility.rays import height_margin, sensor_rays
from torchelev.stages.visibility.steps import clear_by_steps
from torchelev.state import MapState, Measurement, tally

if TYPE_CHECKING:
    from jaxtyping import Bool


def clear_seen_through(state: MapState, m: Measurement, grid: GridConfig, cfg: RaycastConfig | None) -> MapState:
    """Remove what rays passed below, and bound what no ray saw (paper, Sec. II-E and II-H).

    A known cell goes if a ray's height over it is below h - sigma, it was not hit for `min_time`, and |r . n| > alpha_n
    (eq. 3 and 4), with n the cell's normal and r the direction of the lowest ray, the only one that the table keeps.
    Eq. 4 keeps grazing rays from eroding smooth ground. It is not asked of a ray that `passes_far_below`: the last
    cells of an obstacle that left have tilted normals, and would stay forever.
    The upper bound of an unknown cell is the lowest ray height over it so far. None for `cfg`: the stage is skipped.
    """
    if cfg is None:
        return state
    if cfg.steps is not None:
        return clear_by_steps(state, m, grid, cfg, cfg.steps)
    polar, before = PolarGrid.of(grid, cfg), state.validity
    for s in range(m.origin.shape[1]):
        rays = sensor_rays(m, s)
        bins = bins_of(accepted_rays(state, m, rays, grid, cfg), polar, grid)
        state = apply_rays(state, bins, view_from(state, m, rays.origin, grid), polar, grid, cfg)
    return tally(state, cleared_seen_through=count(before & ~state.validity))


def apply_rays(
    state: MapState, rays: RayBins, view: View, polar: PolarGrid, grid: GridConfig, cfg: RaycastConfig
) -> MapState:
    """Apply the lowest of one sensor's rays over each cell."""
    table = lowest_slopes(rays, polar)
    return clear_and_bound(state, find_lowest_rays(state, view, table, polar, grid), grid, cfg)


def clear_and_bound(state: MapState, ray: RayOverCell, grid: GridConfig, cfg: RaycastConfig) -> MapState:
    """Apply the lowest ray of one sensor to every cell (paper, eq. 3 and 4).

    A cell goes if p_z < h - sigma (3) and |r . n| > alpha_n (4), and if it was not hit for `min_time`.
    """
    h, sigma, p_z = state.elevation, state.variance.sqrt(), ray.height
    passes_below = h - p_z > sigma
    is_credible = (ray.incidence > cfg.min_incidence) | passes_far_below(state, h - p_z, grid, cfg)
    is_old = state.time > cfg.min_time
    gone = ray.found & passes_below & is_old & is_credible
    return lower_upper_bound(refute_challengers(state._replace(validity=state.validity & ~gone), ray), ray)


def refute_challengers(state: MapState, ray: RayOverCell) -> MapState:
    """Forget challengers that a ray passes below, and those of cells that are not known.

    Nothing stands there: outliers stop no other ray. From a cell's centre to its corner a ray falls by 0.71 of `fall`;
    those that end on an obstacle's top, more than a cell behind, pass higher than that.
    """
    refutes = ray.found & (ray.height < state.challenger + math.sqrt(0.5) * ray.fall)
    return state._replace(challenger_support=torch.where(refutes | ~state.validity, 0, state.challenger_support))


def lower_upper_bound(state: MapState, ray: RayOverCell) -> MapState:
    """Lower the upper bound of unknown cells to the ray's height (paper, Sec. II-H)."""
    bounds = ray.found & ~state.validity
    lower = torch.where(state.bounded, torch.minimum(state.upper_bound, ray.height), ray.height)
    upper_bound = torch.where(bounds, lower, state.upper_bound)  # which may be infinite where nothing is bounded
    return state._replace(bounded=bounds | (state.bounded & ~state.validity), upper_bound=upper_bound)


def passes_far_below(state: MapState, depth: Tensor, grid: GridConfig, cfg: RaycastConfig) -> Bool[Tensor, "B H W"]:
    """Return where a ray passes so far below a cell that no grazing ray over its plane could, whatever the normal.

    depth > gate * sqrt(sigma^2 + (resolution / 2)^2) + |gradient| * resolution / 2: the noise, the relief within the
    cell, and what its plane rises from the centre to the border.
    """
    rise = (state.gradient_x.square() + state.gradient_y.square()).sqrt() * (0.5 * grid.resolution)
    return depth > height_margin(state.variance, grid, cfg) + rise


def count_bounded(state: MapState) -> MapState:
    """Count the unknown cells that have an upper bound."""
    return tally(state, cells_bounded=count(state.bounded & ~state.validity))
