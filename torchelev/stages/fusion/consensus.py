"""The height that the points of a cell agree on, before it is decided which of them count."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.masks import where_finite
from torchelev.ops.storage import as_bytes, realize, realize_all
from torchelev.stages.fusion.config import EdgeConfig, FusionConfig
from torchelev.stages.fusion.contested import NO_HEIGHT, CellHeights, ContestedCells, SelectedCells, ratio
from torchelev.stages.fusion.edges import side_of_step
from torchelev.stages.fusion.points import Prior, ScanPoints, agrees, gate_variance

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


def robust_mean(points: ContestedCells) -> Tensor:
    """Return each cell's robust mean (K,) [m] above its mean.

    From the mean on, twice: the mean under the weights w / (1 + r^2 / sigma^2)^2 of the residuals r, which leave an
    outlier out.
    """
    height = reduced_mean(points, points.z)
    return height + reduced_mean(points, points.z - points.at_points(height))


def reduced_mean(points: ContestedCells, residual: Tensor) -> Tensor:
    """Return each cell's mean (K,) of the residuals (P,) [m], those far from zero reduced in weight."""
    reduced = points.weight / (1.0 + residual.square() / points.spread).square()
    moment, total = points.sum(torch.stack([reduced * residual, reduced])).unbind(0)
    return ratio(moment, total)


def resolve_contested(
    points: ContestedCells,
    height: Float[Tensor, "B C"],
    shown: CellHeights,
    width: int,
    gate: float,
    relief: float,
    edges: EdgeConfig | None,
) -> tuple[Float[Tensor, "B C"], Int[Tensor, "B C"]]:
    """Resolve the contested cells: return all heights [m], and the side of each cell: +1 top, -1 ground, 0 no step.

    A contested cell gets the robust mean of its points, or, if it is marked as a step or too many of its points are far
    from that mean, the height of one end of the step. The other cells keep their `height`. `width` counts cells along
    y, `relief` is in [m].
    """
    settled, side = robust_mean(points), torch.zeros_like(points.mean)
    if edges is not None:
        residual = points.z - points.at_points(settled)
        near = points.used * (residual.square() <= gate**2 * points.spread)
        number, close = points.sum(torch.stack([points.used, near])).unbind(0)
        step = edges.has_step(number, number - close) | (points.of(points.marked) > 1)
        if points.any_true(step):
            which, end = side_of_step(points, shown, width, relief, edges)
            settled, side = torch.where(step, end, settled), torch.where(step, which, side)
    nowhere = torch.zeros_like(height, dtype=torch.int8)
    return points.put(height, points.mean + settled), points.put(nowhere, side.to(torch.int8))


class Consensus(NamedTuple):
    """What a cell's height is about, before the points that count are chosen. Without a gradient."""

    height: Float[Tensor, "B C"]  #: [m]
    side: Int[Tensor, "B C"]  #: of a step: +1 top, -1 ground, 0 no step
    trusted: Bool[Tensor, "B C"]  #: most points agree with the cell's elevation, whose variance then widens the gate
    number: Float[Tensor, "B C"]  #: of the scan's points
    variance: Float[Tensor, "B C"]  #: [m^2] of their mean, 1e12 without any
    near: Bool[Tensor, "B M"]  #: points that agree with the cell's elevation
    gate_at: Float[Tensor, "B M"]  #: [m^2] of the elevation of each point's cell
    contested: SelectedCells  #: cells with points most of which contradict the elevation, or with a challenger


def estimate_consensus(scan: ScanPoints, prior: Prior, grid: GridConfig, cfg: FusionConfig) -> Consensus:
    """Trust a cell's elevation where most points agree with it, else the robust mean, and at a step one of its ends."""
    elevation_at, variance_at = scan.cells.take(prior.elevation, prior.variance)
    gate_at = gate_variance(variance_at, cfg)
    near, gate_at = realize_all(agrees(scan, elevation_at, gate_at, cfg), gate_at)
    number, agreeing, weight, moment = scan.sums(scan.used, near, scan.weight, scan.weight * scan.z)
    number = realize(number.clamp(min=0))  # a copy of its own, or all four sums would be held as long as this one
    mean = ratio(moment, weight).detach()
    trusted = realize(prior.known & (2 * agreeing >= number))  # or the sums would be held for it
    # A single point is its cell's robust mean, and most cells of a sparse scan have one.
    step, untrusted = torch.zeros_like(trusted), ~trusted & (number > 1)
    if (edges := cfg.edges) is not None:
        step = trusted & edges.has_step(number, number - agreeing)
    height = where_finite(trusted, prior.elevation, mean).detach()
    shown = CellHeights(
        where_finite(number > 0, mean, NO_HEIGHT), where_finite(prior.known, prior.elevation.detach(), NO_HEIGHT)
    )
    contested = SelectedCells(as_bytes((number > 0) & ((prior.known & ~trusted) | (prior.challenger_support > 0))))
    cells = as_bytes(untrusted) + 2 * as_bytes(step)
    points = ContestedCells(cells, scan.cells.slot, scan.columns(), shown.scan)
    height, side = resolve_contested(points, height, shown, grid.width, cfg.gate, cfg.relief * grid.resolution, edges)
    variance = (1.0 / weight.detach().clamp(min=1e-12)).clamp(min=cfg.scan_variance_floor)
    return Consensus(height, side, trusted, number, variance, near, gate_at, contested)
