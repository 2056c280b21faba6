"""The metric of overlap clearance."""

from __future__ import annotations

import torch

from benchmarks.quality.features.reading import (
    Figures,
    cells_of,
    fuse,
    near_step,
    percent,
)
from benchmarks.quality.features.recordings import DT, SimulatedRun
from torchelev.config import ElevationMapConfig
from torchelev.elevation_map import ElevationMap


def other_floor(recording: SimulatedRun, cfg: ElevationMapConfig) -> tuple[Figures, ElevationMap]:
    """Measure what the map keeps of the floor that the robot left.

    `other floor [%]`: how many of the known cells within 3 m of the robot have an error above half a storey (1.36 m) in
    the last map, cells near a step of the truth excluded. `worst [%]`: the largest such value in any map from 5 s after
    the robot reached the new floor.
    """
    last, worst = recording.frames[-1].T_map_base[0, 2, 3], [0.0]

    def on_other_floor(emap: ElevationMap, k: int) -> float:
        cells = cells_of(emap, recording, k)
        distance = (cells.xy - recording.frames[k].T_map_base[0, :2, 3]).norm(dim=-1)
        judged, wrong = (distance <= 3.0) & cells.error.isfinite(), cells.error.abs() > 1.36
        at_edge = wrong.clone()
        at_edge[wrong] = near_step(recording, cells.xy[wrong], k)
        return percent(wrong, judged & ~at_edge)

    heights = torch.stack([frame.T_map_base[0, 2, 3] for frame in recording.frames])
    arrived = int(torch.nonzero((heights - last).abs() > 0.2).max()) + 1

    def watch(emap: ElevationMap, k: int) -> None:
        if k >= arrived + round(5 / DT):
            worst.append(on_other_floor(emap, k))

    emap = fuse(recording, cfg, watch)
    return {"other floor [%]": on_other_floor(emap, -1), "worst [%]": max(worst)}, emap
