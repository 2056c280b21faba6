"""The height update: one scan's points of a cell become one estimate, which the cell takes or rejects."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.masks import count
from torchelev.ops.storage import stored
from torchelev.stages.cells import cells_of
from torchelev.stages.fusion.challenge import Challenge, challenge_from_above
from torchelev.stages.fusion.config import FusionConfig
from torchelev.stages.fusion.consensus import Consensus, estimate_consensus
from torchelev.stages.fusion.contested import ratio
from torchelev.stages.fusion.points import Prior, ScanPoints, agrees, gate_variance, gather_points, gather_prior
from torchelev.state import BLANK, MapState, Measurement, tally

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


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
    scan, prior = gather_points(m, cells_of(state, m, grid), grid, cfg), gather_prior(state)
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


class CellMeasurement(NamedTuple):
    """What the scan says of each cell."""

    height: Float[Tensor, "B C"]  #: [m] z_s
    variance: Float[Tensor, "B C"]  #: [m^2] R
    kept: Float[Tensor, "B C"]  #: points that make up the height
    votes: Float[Tensor, "B C"]  #: points for the height
    dissent: Float[Tensor, "B C"]  #: points against it
    agreeing: Float[Tensor, "B C"]  #: points for the cell's elevation


def measure_cells(
    scan: ScanPoints, prior: Prior, consensus: Consensus, cfg: FusionConfig
) -> tuple[CellMeasurement, Tensor]:
    """Average the points within the gate around the consensus and on its side; return also those that the side ignores.

    1 / R = sum 1 / sigma_p^2,    z_s = R * sum p_z / sigma_p^2.
    """
    height_at, side_at, trusted_at = scan.cells.take(consensus.height, consensus.side, consensus.trusted)
    kept, ignored = choose_points(scan, height_at, consensus.gate_at * trusted_at, side_at, cfg)
    weight = torch.where(kept, scan.weight, 0.0)
    # Around the consensus, so that float32 keeps millimetres at any altitude.
    columns = (weight, weight * (scan.z - height_at), kept, ignored, consensus.near & ~ignored)
    information, moment, kept_number, edge, agreeing = scan.sums(*columns)
    height = consensus.height + ratio(moment, information)
    # The paper ignores the points below a wall's top: a scan of its lower part alone does not contradict the top.
    is_settled = prior.support >= (cfg.edges.min_settled if cfg.edges is not None else 0.0)
    is_lower_part = (consensus.side > 0) & (height < prior.elevation) & is_settled
    votes = kept_number + edge  # points on the face of a wall support its top
    cells = CellMeasurement(
        height=height,
        # Cells without points need a finite one.
        variance=(1.0 / information.clamp(min=1e-12)).clamp(min=cfg.scan_variance_floor),
        kept=kept_number,
        votes=votes,
        dissent=consensus.number - votes,
        agreeing=torch.where(is_lower_part, votes, agreeing),
    )
    return cells, ignored


@stored
def choose_points(
    scan: ScanPoints, height: Tensor, variance: Tensor, side: Tensor, cfg: FusionConfig
) -> tuple[Tensor, Tensor]:
    """Return which points (B, M) are kept, and which are ignored as being of the other side of their cell's step."""
    margin = cfg.edges.margin if cfg.edges is not None else 0.0
    ignored = scan.used & (side * (scan.z - height) < -margin * scan.spread.sqrt())
    return agrees(scan, height, variance, cfg) & ~ignored, ignored


class Decision(NamedTuple):
    """What becomes of each cell."""

    agrees: Bool[Tensor, "B C"]  #: the scan's height lies within the gate of the elevation, and updates it
    founds: Bool[Tensor, "B C"]  #: the scan's height replaces the elevation, or is the first
    takes: Bool[Tensor, "B C"]  #: either of the two
    support: Float[Tensor, "B C"]  #: points for the elevation less those against it, before a cell is founded


def decide_by_vote(
    prior: Prior, measured: CellMeasurement, challenge: Challenge, cfg: FusionConfig, relief: float
) -> Decision:
    """Decide by the gate and the majority vote whether a cell takes the scan's height; `relief` is in [m]."""
    agrees = gate_cells(prior, measured, cfg, relief)
    votes = torch.where(agrees, measured.votes - measured.dissent, measured.agreeing - measured.votes)
    support = prior.support + votes
    founds, takes = take_heights(measured.kept > 0, agrees, ~prior.known | (support < 0) | challenge.won)
    return Decision(agrees, founds, takes, support)


@stored
def gate_cells(prior: Prior, measured: CellMeasurement, cfg: FusionConfig, relief: float) -> Bool[Tensor, "B C"]:
    """Tell where the scan's height agrees with the elevation: (z_s - h)^2 <= gate^2 (sigma_m^2 + R + relief^2)."""
    innovation = measured.height - prior.elevation
    variance = gate_variance(prior.variance, cfg) + measured.variance + relief**2
    return prior.known & (measured.kept > 0) & (innovation.square() <= cfg.gate**2 * variance)


@stored
def take_heights(is_hit: Tensor, agrees: Tensor, is_open: Tensor) -> tuple[Tensor, Tensor]:
    """Return which cells the scan founds anew, those hit and open to it, and which take its height at all."""
    founds = is_hit & ~agrees & is_open
    return founds, agrees | founds


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
