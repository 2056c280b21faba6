"""The majority vote: whether a cell takes the height that the scan measured."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.stages.fusion.cell_measurement import CellMeasurement
from torchelev.stages.fusion.challenge import Challenge
from torchelev.stages.fusion.config import FusionConfig
from torchelev.stages.fusion.points import Prior, gate_variance

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


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


def gate_cells(prior: Prior, measured: CellMeasurement, cfg: FusionConfig, relief: float) -> Bool[Tensor, "B C"]:
    """Return where the scan's height agrees with the elevation: (z_s - h)^2 <= gate^2 (sigma_m^2 + R + relief^2)."""
    innovation = measured.height - prior.elevation
    variance = gate_variance(prior.variance, cfg) + measured.variance + relief**2
    return prior.known & (measured.kept > 0) & (innovation.square() <= cfg.gate**2 * variance)


def take_heights(is_hit: Tensor, agrees: Tensor, is_open: Tensor) -> tuple[Tensor, Tensor]:
    """Return which cells the scan founds anew, those hit and open to it, and which take its height at all."""
    founds = is_hit & ~agrees & is_open
    return founds, agrees | founds
