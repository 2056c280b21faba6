"""Footholds on unknown ground close behind an edge: how often a predicted height is that of the ground."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.quality.occlusion.rules import PREDICTED, predict, true_heights
from benchmarks.quality.occlusion.scenes import Case
from torchelev import ElevationMap

REACH, HALF_WIDTH = 0.3, 0.5  # [m] behind an edge, and to both sides of the robot
CLOSE = 0.03  # [m] error at which a foot still lands as planned


def score(emap: ElevationMap, case: Case) -> tuple[int, dict[str, int]]:
    """Return the number of unknown cells where a foot may land, and at how many each rule is within CLOSE."""
    xy, true = emap.cell_centers()[0], true_heights(emap, case)
    wanted = _is_behind_edge(xy, case) & ~emap.state.validity[0]
    right = {}
    for rule in PREDICTED:
        height, known = predict(emap, rule)
        is_close = known & ((height - true).abs() <= CLOSE)
        right[rule] = int((is_close[0] & wanted).sum())
    return int(wanted.sum()), right


def _is_behind_edge(xy: Tensor, case: Case) -> Tensor:
    """Return which cells (H, W) lie at most REACH behind an edge."""
    x, y = xy.unbind(-1)
    behind = torch.stack([(x > edge) & (x <= edge + REACH) for edge in case.edges]).any(0)
    return behind & (y.abs() <= HALF_WIDTH)
