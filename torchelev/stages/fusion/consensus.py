"""The height that the points of a cell agree on, before it is decided which of them count."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.indexing import SelectedCells
from torchelev.stages.fusion.config import EdgeConfig, FusionConfig
from torchelev.stages.fusion.contested import NO_HEIGHT, CellHeights, ContestedCells, ratio
from torchelev.stages.fusion.edges import side_of_step
from torchelev.stages.fusion.points import Prior, ScanPoints, agrees, gate_variance, misfit

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

    A contested cell gets the robust mean of its points, or, if it is marked as a step or its points do not fit that
    mean, the height of one end of the step. The other cells keep their `height`. `width` counts cells along
    y, `relief` is in [m].
    """
    settled, side = robust_mean(points), torch.zeros_like(points.mean)
    if edges is not None:
        residual = points.z - points.at_points(settled)
        columns = torch.stack([points.used, points.used * misfit(residual, points.spread, gate)])
        step = edges.has_step(*points.sum(columns).unbind(0)) | points.has_step
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
    near, misfits, gate_at = compare_with_prior(scan, prior, cfg)
    columns = scan.used, near, misfits, scan.weight, scan.weight * scan.z
    number, agreeing, total_misfit, weight, moment = scan.sums(*columns)
    number, trusted = trust_majority(number, agreeing, prior.known)
    mean = ratio(moment, weight).detach()
    has_step = torch.zeros_like(trusted)
    if cfg.edges is not None:
        has_step = trusted & cfg.edges.has_step(number, total_misfit)
    elevation = prior.elevation.detach()
    shown = CellHeights(torch.where(number > 0, mean, NO_HEIGHT), torch.where(prior.known, elevation, NO_HEIGHT))
    # A single point is its cell's robust mean, and most cells of a sparse scan have one.
    points = ContestedCells(~trusted & (number > 1), has_step, scan.cells.slot, scan.columns(), shown.scan)
    height, relief = torch.where(trusted, elevation, mean), cfg.relief * grid.resolution
    height, side = resolve_contested(points, height, shown, grid.width, cfg.gate, relief, cfg.edges)
    variance = (1.0 / weight.detach().clamp(min=1e-12)).clamp(min=cfg.scan_variance_floor)
    variance = scan.add_shared(variance, scan.weight, weight).detach()
    is_challenged = (number > 0) & ((prior.known & ~trusted) | (prior.challenger_support > 0))
    return Consensus(height, side, trusted, number, variance, near, gate_at, SelectedCells(is_challenged))


def compare_with_prior(scan: ScanPoints, prior: Prior, cfg: FusionConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Return which points agree with their cell's elevation, their misfits, and the variance [m^2] of its gate."""
    elevation_at, variance_at = scan.cells.take(prior.elevation, prior.variance)
    gate_at = gate_variance(variance_at, cfg)
    misfits = scan.used * misfit(scan.z - elevation_at, scan.spread + gate_at, cfg.gate)
    return agrees(scan, elevation_at, gate_at, cfg), misfits, gate_at


def trust_majority(number: Tensor, agreeing: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Return the number of each cell's points, and whether its elevation is known and at least half agree with it."""
    return number.clamp(min=0), known & (2 * agreeing >= number)
