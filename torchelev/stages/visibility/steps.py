"""Visibility clean-up by steps: every ray is sampled along its way, and lowers the validity of cells that it passes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig, locate
from torchelev.ops.indexing import read
from torchelev.ops.masks import count
from torchelev.ops.transforms import is_readable
from torchelev.stages.cells import lattice_offset
from torchelev.stages.visibility.config import RaycastConfig, SteppingConfig
from torchelev.state import MapState, Measurement, tally

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

NEAR_END = 0.1**0.5  # [m] of its end in which a ray says nothing
MARGIN, MARGIN_PER_VARIANCE = 0.01, 0.05  # [m], [1/m] below an elevation that a ray must pass


class _Rays(NamedTuple):
    """All rays of a measurement."""

    origin: Float[Tensor, "B M 3"]  #: [m]
    direction: Float[Tensor, "B M 3"]  #: of length 1
    distance: Float[Tensor, "B M"]  #: [m] from the sensor to the point
    length: Float[Tensor, "B M"]  #: [m] up to which it is followed; 0 of points that cast none


class _Cells(NamedTuple):
    """What rays read of cells, flat."""

    limit: Float[Tensor, "B C"]  #: [m] lower rays contradict the cell: none do so where it is unknown
    gradient_x: Float[Tensor, "B C"]  #: dz/dx
    gradient_y: Float[Tensor, "B C"]  #: dz/dy


class _Passes(NamedTuple):
    """What rays do to cells, flat."""

    lowest: Float[Tensor, "B C"]  #: [m] of the rays over the cell
    removed: Float[Tensor, "B C"]  #: of the validity
    number: Float[Tensor, "B C"]  #: rays that contradict the elevation


def clear_by_steps(
    state: MapState, m: Measurement, grid: GridConfig, cfg: RaycastConfig, steps: SteppingConfig
) -> MapState:
    """Follow each ray in steps of resolution / sqrt(2) up to `max_range`, and apply it to every cell that it passes.

    A ray at height p_z contradicts a known cell, not hit for `min_time`, if p_z < h - MARGIN + MARGIN_PER_VARIANCE *
    min(sigma_m^2, 1 m^2), and |r . n| >= min_incidence. It takes validity_per_ray * max_range / length off the cell's
    validity, with the ray's length up to `max_range`, and adds `variance_per_ray` to the variance. A cell whose
    validity, in `support`, falls below one half is forgotten. The upper bound of a cell that is not known then is the
    lowest ray over it. A ray says nothing within NEAR_END of its end; points above the exclusion ramp cast none.
    """
    reach = cfg.reach(grid)
    rays = _rays_of(m, reach)
    weight = steps.validity_per_ray * reach / rays.length.clamp(min=1e-6)
    passes = _follow(rays, weight, _read_cells(state, cfg), lattice_offset(state, m, grid), grid, cfg)
    lowest, removed, number = (layer.view(state.elevation.shape) for layer in passes)
    # Cells that no scan founded, as by `initialize`, have another support: they count as whole.
    whole = (state.support < 0.5) | (state.support > 1)
    left = torch.where(whole, 1.0, state.support) - removed
    gone = state.validity & (left < 0.5)
    validity = state.validity & ~gone
    bound = torch.where(state.bounded, torch.minimum(state.upper_bound, lowest), lowest)
    found = (lowest < torch.inf) & ~validity
    state = state._replace(
        validity=validity,
        support=torch.where(validity, left, 0.0),
        variance=state.variance + steps.variance_per_ray * number,
        upper_bound=torch.where(found, bound, state.upper_bound),
        bounded=(state.bounded & ~validity) | found,
    )
    return tally(state, cleared_seen_through=count(gone))


def _read_cells(state: MapState, cfg: RaycastConfig) -> _Cells:
    limit = state.elevation - MARGIN + MARGIN_PER_VARIANCE * state.variance.clamp(max=1)
    limit = torch.where(state.validity & (state.time >= cfg.min_time), limit, -torch.inf)
    return _Cells(*(layer.flatten(1) for layer in (limit, state.gradient_x, state.gradient_y)))


def _rays_of(m: Measurement, reach: float) -> _Rays:
    points = m.points.shape[1] // m.origin.shape[1]
    origin = m.origin.repeat_interleave(points, 1)
    ray = m.points - origin
    distance = ray.square().sum(-1).clamp(min=1e-12).sqrt()
    length = torch.where(m.used, distance.clamp(max=reach), 0.0)
    return _Rays(origin, ray / distance[..., None], distance, length)


def _follow(
    rays: _Rays, weight: Tensor, cells: _Cells, offset: Tensor, grid: GridConfig, cfg: RaycastConfig
) -> _Passes:
    """Follow all rays at once, step by step; each removes its weight of the validity of cells that it contradicts."""
    step = grid.resolution / math.sqrt(2)
    passes = _Passes(torch.full_like(cells.limit, torch.inf), *(torch.zeros_like(cells.limit) for _ in range(2)))
    last = torch.full(rays.length.shape, -1, dtype=torch.int32, device=rays.length.device)
    for k in range(1, math.ceil(_longest(rays.length, cfg.reach(grid)) / step) + 1):
        s = k * step
        at = rays.origin + rays.direction * s
        slot, inside = locate(at[..., 0], at[..., 1], offset, grid)
        counts = inside & (s < rays.length) & (slot != last) & (rays.distance - s >= NEAR_END)
        last = torch.where(inside, slot, last)
        height, slot = at[..., 2], slot.to(torch.int64)
        contradicts = counts & _contradict(cells, rays.direction, height, slot, cfg.min_incidence)
        passes = _add(passes, contradicts, counts, height, slot, weight)
    return passes


def _longest(length: Tensor, reach: float) -> float:
    """Return the length [m] of the longest ray, or what it is at most where the host would have to wait."""
    if not length.numel():
        return 0.0
    return float(length.detach().max()) if is_readable(length) else reach


def _add(
    passes: _Passes, contradicts: Tensor, counts: Tensor, height: Tensor, slot: Int[Tensor, "B M"], weight: Tensor
) -> _Passes:
    return _Passes(
        passes.lowest.scatter_reduce(1, slot, torch.where(counts, height, torch.inf), "amin"),
        passes.removed.scatter_add(1, slot, torch.where(contradicts, weight, 0.0)),
        passes.number.scatter_add(1, slot, contradicts.to(weight.dtype)),
    )


def _contradict(
    cells: _Cells, direction: Tensor, height: Tensor, slot: Tensor, min_incidence: float
) -> Bool[Tensor, "B M"]:
    """Return which rays at heights [m] over the cells `slot` contradict their elevations."""
    gx, gy = read(cells.gradient_x, slot), read(cells.gradient_y, slot)
    x, y, z = direction.unbind(-1)
    incidence = (z - gx * x - gy * y).abs() / (1 + gx * gx + gy * gy).sqrt()
    return (height < read(cells.limit, slot)) & (incidence >= min_incidence)
