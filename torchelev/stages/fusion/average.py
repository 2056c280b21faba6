"""Averaged fusion: each point updates the cell as it was before the scan, and the results are averaged."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.masks import count
from torchelev.ops.scatter import lowest
from torchelev.stages.cells import PointCells, cells_of
from torchelev.stages.fusion.config import AveragingConfig
from torchelev.stages.pose_error import relative_variance
from torchelev.state import MapState, Measurement, tally

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


class _Points(NamedTuple):
    """What becomes of the points."""

    outlier: Bool[Tensor, "B M"]  #: disagrees with its cell
    edge: Bool[Tensor, "B M"]  #: lies below the top of a wall
    accepted: Bool[Tensor, "B M"]  #: updates its cell
    variance: Float[Tensor, "B M"]  #: [m^2] of its cell, with what the outliers add


def average(state: MapState, m: Measurement, grid: GridConfig, cfg: AveragingConfig, max_variance: float) -> MapState:
    """Fuse each point with the cell as it was before the scan, and average what comes out.

        h_p = (sigma_p^2 h + sigma_m^2 z) / (sigma_m^2 + sigma_p^2),    h <- mean of h_p,
        v_p = sigma_m^2 sigma_p^2 / (sigma_m^2 + sigma_p^2),            sigma_m^2 <- mean of v_p

    over the accepted points, so that many points of a cell lower its variance as one does. Outliers, `_judge`, raise it
    before. A cell whose variance grows beyond `max_variance` [m^2] is forgotten. `support` is the share of a cell's
    validity that rays have left: 1 after a hit.
    """
    cells = cells_of(state, m, grid)
    z, of_pose = m.points[..., 2], relative_variance(state, m)
    noise = m.variance if m.noise is None else m.noise
    noise = noise if of_pose is None else noise + of_pose
    h, v = cells.take(state.elevation, torch.where(state.validity, state.variance, cfg.unknown_variance))
    points = _judge(z, h, v, cells, cfg)
    share = torch.where(points.accepted, points.variance / (points.variance + noise), 0.0)
    columns = (points.accepted, share * (z - h), share * noise, points.outlier)
    sums = cells.sums(*(column.to(z.dtype) for column in columns))
    number, moved, left, outliers = (total.view(state.elevation.shape) for total in sums)
    hit, per = number > 0, 1 / number.clamp(min=1)
    taken = hit & (left * per <= max_variance)
    refuted = state.variance + cfg.variance_per_outlier * outliers * state.validity
    return tally(
        state._replace(
            elevation=torch.where(taken, state.elevation + moved * per, state.elevation),
            variance=torch.where(taken, left * per, refuted),
            validity=torch.where(hit, taken, state.validity),
            support=torch.where(hit, taken.to(z.dtype), state.support),
            time=torch.where(hit, 0.0, state.time),
            bounded=state.bounded & ~taken,
        ),
        points_used=count(points.accepted),
        rejected_outside=count(m.used & ~cells.inside),
        rejected_edge=count(points.edge),
        rejected_outlier=count(points.outlier),
    )


def _judge(z: Tensor, h: Tensor, v: Tensor, cells: PointCells, cfg: AveragingConfig) -> _Points:
    """Return what becomes of points at heights z [m], over cells of elevation h [m] and variance v [m^2].

    A point is an outlier if |z - h| > gate_per_variance * sigma_m^2, and adds `variance_per_outlier` to the variance,
    which widens the gate for the next: the farthest point comes first, so that the order of the points does not matter.
    In a cell of N > `wall_points` points, those with z < h - gate_per_variance * sigma_m^2 / N are ignored.
    """
    distance = (z - h).abs()
    rank, number = _ranks(distance, cells)
    fits = distance <= cfg.gate_per_variance * (v + cfg.variance_per_outlier * rank)
    # The gate widens and the distances shrink: all after the first that fits do so, too.
    first = lowest(cells.slot, torch.where(fits & cells.inside, rank, torch.inf), cells.num_cells, torch.inf)
    first, number = cells.take(torch.minimum(first, number), number)
    outlier = cells.inside & (rank < first)
    variance = v + cfg.variance_per_outlier * first
    edge = torch.zeros_like(outlier)
    if cfg.wall_points is not None:
        below = z < h - cfg.gate_per_variance * variance / number.clamp(min=1)
        edge = cells.inside & ~outlier & (number > cfg.wall_points) & below
    return _Points(outlier, edge, cells.inside & ~outlier & ~edge, variance)


def _ranks(distance: Float[Tensor, "B M"], cells: PointCells) -> tuple[Float[Tensor, "B M"], Float[Tensor, "B C"]]:
    """Return how many points of its cell lie farther than each point inside, and how many points each cell has."""
    (number,) = cells.sums(cells.inside.to(distance.dtype))
    order = torch.where(cells.inside, distance, -1.0).argsort(dim=1, descending=True, stable=True)
    slot = torch.where(cells.inside, cells.slot, cells.num_cells).gather(1, order)  # those outside last
    by_cell = slot.argsort(dim=1, stable=True)
    order, slot = order.gather(1, by_cell), slot.gather(1, by_cell).clamp(max=cells.num_cells - 1)
    start = (number.cumsum(1, dtype=torch.float64) - number).gather(1, slot)
    rank = torch.arange(slot.shape[1], device=slot.device) - start
    return torch.zeros_like(distance).scatter(1, order, rank.to(distance.dtype)), number
