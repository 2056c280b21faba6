"""One height and variance for the points of each cell: those that count, averaged."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.stages.fusion.config import FusionConfig
from torchelev.stages.fusion.consensus import Consensus
from torchelev.stages.fusion.contested import ratio
from torchelev.stages.fusion.points import Prior, ScanPoints, agrees

if TYPE_CHECKING:
    from jaxtyping import Float


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
    # Cells without points need a finite one.
    variance = (1.0 / information.clamp(min=1e-12)).clamp(min=cfg.scan_variance_floor)
    cells = CellMeasurement(
        height=height,
        variance=scan.add_shared(variance, weight, information),
        kept=kept_number,
        votes=votes,
        dissent=consensus.number - votes,
        agreeing=torch.where(is_lower_part, votes, agreeing),
    )
    return cells, ignored


def choose_points(
    scan: ScanPoints, height: Tensor, variance: Tensor, side: Tensor, cfg: FusionConfig
) -> tuple[Tensor, Tensor]:
    """Return which points (B, M) are kept, and which are ignored as being of the other side of their cell's step."""
    margin = cfg.edges.margin if cfg.edges is not None else 0.0
    ignored = scan.used & (side * (scan.z - height) < -margin * scan.spread.sqrt())
    return agrees(scan, height, variance, cfg) & ~ignored, ignored
