"""The height update: one scan's points of a cell become one estimate, which the cell takes or rejects."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.masks import as_factor, masked, where_finite, zeroed
from torchelev.ops.storage import as_bytes, realize, realize_all
from torchelev.stages.cells import cells_of
from torchelev.stages.fusion.challenge import Challenge, challenge_from_above
from torchelev.stages.fusion.config import FusionConfig
from torchelev.stages.fusion.consensus import Consensus, estimate_consensus
from torchelev.stages.fusion.contested import ratio
from torchelev.stages.fusion.points import Prior, ScanPoints, agrees, gate_variance, gather_points, gather_prior
from torchelev.state import BLANK, MapState, Measurement, count, tally

if TYPE_CHECKING:
    from jaxtyping import Float


def fuse(state: MapState, m: Measurement, grid: GridConfig, cfg: FusionConfig, has_rays: bool) -> MapState:
    """Fuse the scan into the map (paper, Sec. II-C).

    Within the scan, the points of a cell become one height z_s by consensus: those within the Mahalanobis gate of
    the cell's elevation where most agree with it, else those around the scan's own robust mean. In cells that hold a
    step, `edges.side_of_step` tells which side counts, and the points of the other are dropped. The points kept have
    the information sum 1 / R = sum 1 / sigma_p^2 with a floor on R, because the points of one scan share the error of
    its pose.
    Equations (1) and (2), in information form and so in no order:

        1 / sigma^2 = 1 / sigma_m^2 + 1 / R,    h = sigma^2 * (h / sigma_m^2 + z_s / R).

    A cell keeps count of the points that agreed with it, less those that did not (majority vote of Boyer and Moore):
    a height that most points agree on wins, whether or not an outlier came first. A scan that disagrees raises the
    variance, as in the paper, and founds the cell anew once the votes are used up, or once enough points above it agree
    with each other (`challenge`): a new obstacle shows soon, however long the ground before it was seen.
    """
    scan, prior = gather_points(m, cells_of(state, m, grid), grid, cfg), gather_prior(state)
    consensus = estimate_consensus(scan, prior, grid, cfg)
    if has_rays:  # nothing else tells outliers in a blind spot from an obstacle
        challenge = challenge_from_above(prior, consensus, grid.width, cfg.relief * grid.resolution, cfg)
    else:
        unchanged = prior.challenger.clone(), prior.challenger_support.clone()
        challenge = Challenge(*unchanged, torch.zeros_like(prior.known))
    scanned, ignored = measure_cells(scan, prior, consensus, cfg)
    state, taken = merge(state, prior, scanned, challenge, grid, cfg)
    points_used = masked(scanned.kept, taken).sum(1).to(torch.int64)
    return tally(
        state,
        points_used=points_used,
        rejected_outside=count(m.used & ~scan.used),
        rejected_edge=count(ignored),
        rejected_outlier=count(scan.used) - count(ignored) - points_used,
    )


def measure_cells(
    scan: ScanPoints, prior: Prior, consensus: Consensus, cfg: FusionConfig
) -> tuple[CellMeasurement, Tensor]:
    """Average the points that lie within the gate around the consensus and on its side; tell which the side ignores."""
    height_at, side_at, trusted_at = scan.cells.take(consensus.height, consensus.side, as_bytes(consensus.trusted))
    kept, ignored = on_side(scan, height_at, consensus.gate_at * trusted_at, side_at, cfg)
    weight = torch.where(kept, scan.weight, 0.0)
    # Around the consensus, so that float32 keeps millimetres at any altitude.
    columns = (weight, weight * (scan.z - height_at), kept, ignored, consensus.near & ~ignored)
    information, moment, kept_number, edge, agreeing = scan.sums(*columns)
    height = consensus.height + ratio(moment, information)
    # The paper ignores the points below a wall's top: a scan of its lower part alone has nothing against the top.
    settled = prior.support >= (cfg.edges.min_settled if cfg.edges is not None else 0.0)
    lower_part = (consensus.side > 0) & (height < prior.elevation) & settled
    # Points on the face of a wall speak for its top.
    votes = kept_number + edge
    cells = CellMeasurement(
        height=height,
        # Of cells with points; elsewhere it need but be finite.
        variance=(1.0 / information.clamp(min=1e-12)).clamp(min=cfg.scan_variance_floor),
        kept=kept_number,
        votes=votes,
        dissent=consensus.number - votes,
        agreeing=where_finite(lower_part, votes, agreeing),
    )
    return cells, ignored


def on_side(
    scan: ScanPoints, consensus: Tensor, gate: Tensor, side: Tensor, cfg: FusionConfig
) -> tuple[Tensor, Tensor]:
    """Return the points kept and, in cells with a step, the points ignored as being of its other side."""
    residual = side * (scan.z - consensus)
    margin = cfg.edges.margin if cfg.edges is not None else 0.0
    ignored = scan.used & (residual < -margin * scan.spread.sqrt())
    kept, ignored = realize_all(agrees(scan, consensus, gate, cfg) & ~ignored, ignored)
    return kept, ignored


class CellMeasurement(NamedTuple):
    """What the scan says of each cell; heights in [m], the others count points."""

    height: Float[Tensor, "B C"]  #: [m]
    variance: Float[Tensor, "B C"]  #: [m^2]
    kept: Float[Tensor, "B C"]  #: make up the height
    votes: Float[Tensor, "B C"]  #: speak for the height
    dissent: Float[Tensor, "B C"]  #: speak against it
    agreeing: Float[Tensor, "B C"]  #: speak for the cell's elevation


def merge(
    state: MapState, prior: Prior, scan: CellMeasurement, challenge: Challenge, grid: GridConfig, cfg: FusionConfig
) -> tuple[MapState, Tensor]:
    """Take the scan's heights into the cells, or count them as votes against. Returns also where they were taken."""
    hit, innovation = scan.kept > 0, scan.height - prior.elevation
    limit = gate_variance(prior.variance, cfg) + scan.variance + (cfg.relief * grid.resolution) ** 2
    agree = realize(prior.known & hit & (innovation.square() <= cfg.gate**2 * limit))
    votes = where_finite(agree, scan.votes - scan.dissent, scan.agreeing - scan.votes)
    support = prior.support + votes
    found = hit & ~agree & (~prior.known | (support < 0) | challenge.won)
    found, taken = realize_all(found, agree | found)

    information = ratio(as_factor(agree), prior.variance) + 1.0 / scan.variance
    fused = prior.elevation + masked(innovation / (information * scan.variance), taken)
    # Limited before it is multiplied, too: an infinite one would make NaN of cells without points.
    outvoted = prior.variance + min(cfg.outlier_variance, cfg.max_variance) * scan.kept
    posterior = where_finite(
        taken, (1.0 / information).clamp(max=cfg.max_variance), outvoted.clamp(max=cfg.max_variance)
    )
    fresh = where_finite(prior.known & ~challenge.won, -support, scan.votes - scan.dissent)
    support = where_finite(hit, where_finite(found, fresh, support).clamp(0, cfg.max_support), prior.support)

    def store(cells: Tensor) -> Tensor:
        return cells.view(state.elevation.shape)

    hit_now = store(taken)
    elevation, variance, support, challenger, challenger_support, validity, time = realize_all(
        store(fused),
        where_finite(state.validity | hit_now, store(posterior), BLANK["variance"]),
        store(support),
        store(challenge.height),
        store(zeroed(challenge.support, found)),
        state.validity | hit_now,
        torch.where(hit_now, 0.0, state.time),  # not multiplied: it may be infinite
    )
    stored = state._replace(
        elevation=elevation,
        variance=variance,
        support=support,
        challenger=challenger,
        challenger_support=challenger_support,
        validity=validity,
        time=time,
    )
    return stored, taken
