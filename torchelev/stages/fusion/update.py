"""The update of every cell by tensors. `cell.h` and `equation.h` hold its fast form, for C++ and CUDA."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.masks import count
from torchelev.stages.fusion.cell_measurement import CellMeasurement, measure_cells
from torchelev.stages.fusion.challenge import Challenge, challenge_from_above
from torchelev.stages.fusion.config import FusionConfig
from torchelev.stages.fusion.consensus import estimate_consensus
from torchelev.stages.fusion.contested import ratio
from torchelev.stages.fusion.points import CellLayers, HitPoints, Prior, gather_points, gather_prior
from torchelev.stages.fusion.vote import Decision, decide_by_vote

if TYPE_CHECKING:
    from jaxtyping import Int


class Update(NamedTuple):
    """What all cells hold after the scan; and the points, per environment."""

    layers: CellLayers  #: new values, (B, C) or (B, H, W) each
    num_used: Int[Tensor, "B"]  #: points that a cell took
    num_ignored: Int[Tensor, "B"]  #: points on the wrong side of a step


def update_all(points: HitPoints, before: CellLayers, grid: GridConfig, cfg: FusionConfig, has_rays: bool) -> Update:
    """Update all cells; `before` is (B, C) each."""
    scan, prior = gather_points(points, grid, cfg), gather_prior(before)
    consensus = estimate_consensus(scan, prior, grid, cfg)
    if has_rays:  # nothing else distinguishes outliers in a blind spot from an obstacle
        challenge = challenge_from_above(prior, consensus, grid.width, cfg.relief * grid.resolution, cfg)
    else:
        unchanged = prior.challenger.clone(), prior.challenger_support.clone()
        challenge = Challenge(*unchanged, torch.zeros_like(prior.known))
    measured, ignored = measure_cells(scan, prior, consensus, cfg)
    decision = decide_by_vote(prior, measured, challenge, cfg, cfg.relief * grid.resolution)
    layers = update_cells(prior, before.time, measured, challenge, decision, cfg)
    return Update(layers, (measured.kept * decision.takes).sum(1).to(torch.int64), count(ignored))


def kalman_gain(variance: Tensor, R: Tensor, is_prior: Tensor) -> Tensor:
    """Return K = sigma_m^2 / (sigma_m^2 + R), or 1 where there is no prior estimate: then 1 / sigma_m^2 is 0."""
    return 1.0 / (1.0 + R * ratio(is_prior, variance))


def update_cells(
    prior: Prior,
    time: Tensor,
    measured: CellMeasurement,
    challenge: Challenge,
    decision: Decision,
    cfg: FusionConfig,
) -> CellLayers:
    """Update the cells that take the scan's height (paper, eq. 1 and 2); raise the variance of those that it outvotes.

    h <- h + K (z_s - h),    sigma_m^2 <- K R,    K = sigma_m^2 / (sigma_m^2 + R).
    """
    agrees, founds, takes, support = decision
    gain = kalman_gain(prior.variance, measured.variance, agrees)
    h = prior.elevation + takes * gain * (measured.height - prior.elevation)
    sigma2 = (gain * measured.variance).clamp(max=cfg.max_variance)
    # Limited before it is multiplied, too: an infinite one would make NaN of cells without points.
    raised = prior.variance + min(cfg.outlier_variance, cfg.max_variance) * measured.kept
    variance = torch.where(takes, sigma2, raised.clamp(max=cfg.max_variance))
    fresh = torch.where(prior.known & ~challenge.won, -support, measured.votes - measured.dissent)
    support = torch.where(founds, fresh, support).clamp(0, cfg.max_support)
    validity = prior.known | takes
    return CellLayers(
        elevation=h,
        variance=torch.where(validity, variance, prior.variance),
        support=torch.where(measured.kept > 0, support, prior.support),
        challenger=challenge.height,
        challenger_support=torch.where(founds, 0, challenge.support),
        validity=validity,
        time=torch.where(takes, 0.0, time),
    )
