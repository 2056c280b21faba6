"""The metric of drift compensation."""

from __future__ import annotations

import math

import torch

from benchmarks.quality.features.reading import (
    Figures,
    cells_of,
    fuse,
    near_step,
)
from benchmarks.quality.features.recordings import SimulatedRun
from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap


def seam_step(recording: SimulatedRun, cfg: ElevationMapConfig) -> tuple[Figures, ElevationMap]:
    """Measure the height step between recently and long ago measured ground in the last map.

    A seam is a pair of neighboring cells, one hit within the last 0.5 s, the other last hit at least 3 s ago, neither
    near a step of the truth (5 cm within 1.5 cells). Its step is the difference between the errors of the two cells,
    to which a shift of the whole map does not contribute.

    `seam [cm]`: median of the absolute step, range noise included. `seam mean [cm]`: mean of the signed step, new minus
    old. `seam p90 [cm]`: 90th percentile of the absolute step.
    """
    emap = fuse(recording, cfg)
    cells, age = cells_of(emap, recording), emap.layer("time")[0]
    is_level = ~near_step(recording, cells.xy)
    steps = []
    for dim in (0, 1):
        size = age.shape[dim] - 1
        for new, old in ((0, 1), (1, 0)):
            ages, levels, errors = (
                [layer.narrow(dim, first, size) for first in (new, old)] for layer in (age, is_level, cells.error)
            )
            pair = (ages[0] <= 0.5) & (ages[1] >= 3.0) & levels[0] & levels[1]
            steps.append((errors[0] - errors[1])[pair])
    step = torch.cat(steps)
    if not len(step):
        return dict.fromkeys(("seam [cm]", "seam mean [cm]", "seam p90 [cm]", "pairs"), math.nan), emap
    return {
        "seam [cm]": 100 * float(step.abs().median()),
        "seam mean [cm]": 100 * float(step.mean()),
        "seam p90 [cm]": 100 * float(step.abs().quantile(0.9)),
        "pairs": float(len(step)),
    }, emap
