"""Four rules for unknown ground, and the plan of each."""

from __future__ import annotations

import torch

from benchmarks.quality.occlusion.scenes import GRID
from torchelev import ElevationMap, filters
from torchelev.pipeline import rate
from torchelev.planning.planner import Path, plan
from torchelev.planning.traversal_cost import TraversalCostConfig
from torchelev.state import MapState

_IMPASSABLE = TraversalCostConfig(cross_unknown=False)
RULES = ("upper bound", "in-painted by diffusion", "in-painted by the minimum", "unknown is impassable")


def _inpaint(emap: ElevationMap, filter_name: str) -> MapState:
    """Return the state with all unknown ground inpainted and rated like measured ground."""
    layer = (emap.state.elevation, emap.state.validity)
    elevation, known = filters.Filter(filter_name)(layer, resolution=GRID.resolution)
    return rate(emap.state._replace(elevation=elevation, validity=known), emap.cfg)


def decide(emap: ElevationMap, x: float, goal: float) -> dict[str, Path]:
    """Plan a path by each rule from (x, 0) to (goal, 0) [m]."""
    ends = torch.tensor([[x, 0.0]]), torch.tensor([[goal, 0.0]])
    plans = (
        plan(emap, *ends),
        plan(emap, *ends, state=_inpaint(emap, "inpaint_diffusion")),
        plan(emap, *ends, state=_inpaint(emap, "inpaint_minimum")),
        plan(emap, *ends, _IMPASSABLE),
    )
    return dict(zip(RULES, plans, strict=True))
