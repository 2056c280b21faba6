"""The height update: one scan's points of a cell become one estimate, which the cell takes or rejects."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.masks import count
from torchelev.ops.storage import stored
from torchelev.stages.cells import cells_of
from torchelev.stages.fusion.cell_measurement import CellMeasurement, measure_cells
from torchelev.stages.fusion.challenge import Challenge, challenge_from_above
from torchelev.stages.fusion.config import FusionConfig
from torchelev.stages.fusion.consensus import estimate_consensus
from torchelev.stages.fusion.contested import ratio
from torchelev.stages.fusion.points import Prior, gather_points, gather_prior
from torchelev.stages.fusion.vote import Decision, decide_by_vote
from torchelev.stages.pose_error import relative_variance
from torchelev.state import BLANK, MapState, Measurement, tally


def fuse(state: MapState, m: Measurement, grid: GridConfig, cfg: FusionConfig, has_rays: bool) -> MapState:
    """Fuse the scan into the map (paper, Sec. II-C).

    The points of a cell become one height z_s with the variance R (`measure_cells`): those within the Mahalanobis gate
    of the cell's elevation if most points agree with it, else those around the scan's own robust mean. In a cell that
    holds a step, `edges.side_of_step` decides which side counts. The points of one scan share the error of its pose, so
    R has a floor.

    Equations (1) and (2) then update the cell once, in a form that does not depend on the order of the points
    (`update_cells`):

        h <- h + K (z_s - h),    sigma_m^2 <- K R,    K = sigma_m^2 / (sigma_m^2 + R).

    Each cell counts the points that agree with it, less those that do not (majority vote of Boyer and Moore), so that
    the height on which most points agree wins, even if an outlier came first. A scan that disagrees raises the
    variance, as in the paper. It replaces the cell's estimate once the count falls below zero, or once enough points
    above the cell agree with each other (`challenge`): a new obstacle appears soon, even on ground seen for long.
    """
    scan = gather_points(m, cells_of(state, m, grid), relative_variance(state, m), grid, cfg)
    prior = gather_prior(state)
    consensus = estimate_consensus(scan, prior, grid, cfg)
    if has_rays:  # nothing else tells outliers in a blind spot from an obstacle
        challenge = challenge_from_above(prior, consensus, grid.width, cfg.relief * grid.resolution, cfg)
    else:
        unchanged = prior.challenger.clone(), prior.challenger_support.clone()
        challenge = Challenge(*unchanged, torch.zeros_like(prior.known))
    measured, ignored = measure_cells(scan, prior, consensus, cfg)
    decision = decide_by_vote(prior, measured, challenge, cfg, cfg.relief * grid.resolution)
    points_used = (measured.kept * decision.takes).sum(1).to(torch.int64)
    return tally(
        update_cells(state, prior, measured, challenge, decision, cfg),
        points_used=points_used,
        rejected_outside=count(m.used & ~scan.used),
        rejected_edge=count(ignored),
        rejected_outlier=count(scan.used) - count(ignored) - points_used,
    )


def kalman_gain(variance: Tensor, R: Tensor, is_prior: Tensor) -> Tensor:
    """Return K = sigma_m^2 / (sigma_m^2 + R), or 1 where there is no prior estimate: then 1 / sigma_m^2 is 0."""
    return 1.0 / (1.0 + R * ratio(is_prior, variance))


@stored
def update_cells(
    state: MapState,
    prior: Prior,
    measured: CellMeasurement,
    challenge: Challenge,
    decision: Decision,
    cfg: FusionConfig,
) -> MapState:
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
    layers: dict[str, Any] = dict(
        elevation=h,
        variance=torch.where(validity, variance, BLANK["variance"]),
        support=torch.where(measured.kept > 0, support, prior.support),
        challenger=challenge.height,
        challenger_support=torch.where(founds, 0, challenge.support),
        validity=validity,
        time=torch.where(takes, 0.0, state.time.flatten(1)),
    )
    return state._replace(**{name: layer.view(state.elevation.shape) for name, layer in layers.items()})
