"""New obstacles: points above a cell's elevation that agree with each other, however settled the ground below is."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.ops.indexing import SelectedCells
from torchelev.ops.windows import around
from torchelev.stages.fusion.contested import NO_HEIGHT
from torchelev.stages.fusion.edges import values_around

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, UInt8

    from torchelev.stages.fusion.config import FusionConfig
    from torchelev.stages.fusion.consensus import Consensus
    from torchelev.stages.fusion.points import Prior

MIN_CHALLENGERS = 4  # cells of the 3 x 3 window with a challenger, from which on points at any height above count


class Challenge(NamedTuple):
    """What contradicts the elevations from above, after the scan."""

    height: Float[Tensor, "B C"]  #: [m]
    support: UInt8[Tensor, "B C"]  #: points
    won: Bool[Tensor, "B C"]  #: the scan is to found the cell anew


def challenge_from_above(prior: Prior, consensus: Consensus, width: int, relief: float, cfg: FusionConfig) -> Challenge:
    """Let points above the elevation agree with each other.

    The challenger is the lowest height that contradicted the elevation from above, and what lies within the gate of it
    supports it, or all that lies above where `MIN_CHALLENGERS` challengers stand together. Other higher points count
    neither way; a lower one replaces it. A scan that does not contradict the elevation takes its points off. With 6 %
    of the points above the ground, at 0.5 to 10 points a cell, chance gives a cell three scans in a row, and three
    challengers beside it, in fewer than one scan of 10^7. A blind spot, which only outliers hit, is settled by
    `raycast`: rays that pass below the challenger refute it.

    Where a settled cell beside it stands as high as the points, they are another view of a step, which is not new:
    there the majority vote decides alone. The cells of a new obstacle are not settled until most of them show.

    `width` counts cells along y, `relief` is in [m].
    """
    cells = consensus.contested
    known, trusted = cells.of(prior.known), cells.of(consensus.trusted)
    challenger, support = cells.of(prior.challenger), cells.of(prior.challenger_support).to(torch.int32)
    height, number = cells.of(consensus.height), cells.of(consensus.number)
    votes = number.clamp(max=cfg.max_above_per_scan).to(torch.int32)
    variance = cells.of(prior.variance).clamp(max=cfg.max_gate_std**2) + cells.of(consensus.variance) + relief**2
    reach = cfg.gate * variance.sqrt()
    challengers, settled = look_around(prior, cells, width, cfg)
    above = known & ~trusted & (height > cells.of(prior.elevation)) & (height - reach > settled)
    replaced = above & ((support == 0) | (height < challenger - reach))
    backed = challengers >= MIN_CHALLENGERS
    strays = above & ~replaced & ~backed & (height > challenger + reach)
    kept = torch.where(replaced & ~backed, 0, support)
    after = torch.where(strays, kept, kept + torch.where(above, votes, -votes)).clamp(0, cfg.min_above)
    won = above & (after >= cfg.min_above)
    layers = [prior.challenger, prior.challenger_support, torch.zeros_like(prior.known)]
    values = [torch.where(replaced, height, challenger), after.to(torch.uint8), won]
    return Challenge(*cells.put_all(layers, values))


def look_around(
    prior: Prior, cells: SelectedCells, width: int, cfg: FusionConfig
) -> tuple[Int[Tensor, "K"], Float[Tensor, "K"]]:
    """Count the challengers in the 3 x 3 window, and return its highest settled elevation [m], NO_HEIGHT without.

    Before the scan, so that its own outliers vouch for none.
    """
    settled = prior.known & (prior.support >= 0.5 * cfg.max_support)
    layers = [prior.challenger_support, torch.where(settled, prior.elevation, NO_HEIGHT)]
    exists, (supports, heights) = values_around(layers, cells.cells, *around(cells.cells.device), width)
    support, height = (cells.of(layer) for layer in layers)
    number = (support > 0).to(torch.int32) + (exists & (supports > 0)).sum(1, dtype=torch.int32)
    return number, torch.maximum(height, torch.where(exists, heights, NO_HEIGHT).amax(1))
