"""The rules for unknown ground: the plan of each, and the heights that each predicts."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.quality.occlusion.scenes import Case
from benchmarks.quality.occlusion.walks import GRID
from torchelev import ElevationMap, filters
from torchelev.pipeline import rate
from torchelev.planning.planner import Path, plan
from torchelev.planning.traversal_cost import TraversalCostConfig
from torchelev.state import MapState

_CAUTIOUS = TraversalCostConfig(cross_unknown=False)
UPPER_BOUND, IMPASSABLE, TRUTH = "upper bound", "unknown is impassable", "true ground"
INPAINTED = {
    "in-painted by diffusion": "inpaint_diffusion",
    "in-painted by the minimum": "inpaint_minimum",
    "in-painted by the nearest": "inpaint_nearest",
    "in-painted by Telea": "inpaint_telea",
    "in-painted by Navier-Stokes": "inpaint_navier_stokes",
}
PREDICTED = (UPPER_BOUND, *INPAINTED)  # rules that predict a height
RULES = (*PREDICTED, IMPASSABLE, TRUTH)


def predict(emap: ElevationMap, rule: str) -> tuple[Tensor, Tensor]:
    """Return the heights (B, H, W) [m] by one of PREDICTED, as measured where known, and where they are known."""
    if rule == UPPER_BOUND:
        return emap.read_layer("upper_bound")
    return filters.Filter(INPAINTED[rule])(emap.read_layer("elevation"), resolution=GRID.resolution)


def true_heights(emap: ElevationMap, case: Case) -> Tensor:
    """Return the true ground (1, H, W) [m] at the map's cells."""
    return case.scene.truth(emap.cell_centers()[0].double())[None].to(emap.state.elevation.dtype)


def decide(emap: ElevationMap, x: float, case: Case) -> dict[str, Path]:
    """Plan a path by each rule from (x, 0) to the goal behind the edge, with the default settings of the planner."""
    ends = torch.tensor([[x, 0.0]]), torch.tensor([[case.goal, 0.0]])
    true = true_heights(emap, case)
    paths = {UPPER_BOUND: plan(emap, *ends), IMPASSABLE: plan(emap, *ends, _CAUTIOUS)}
    paths |= {rule: plan(emap, *ends, state=_rated(emap, *predict(emap, rule))) for rule in INPAINTED}
    paths[TRUTH] = plan(emap, *ends, state=_rated(emap, true, torch.ones_like(true, dtype=torch.bool)))
    return {rule: paths[rule] for rule in RULES}


def _rated(emap: ElevationMap, elevation: Tensor, known: Tensor) -> MapState:
    """Return the state with this ground, rated like measured ground."""
    return rate(emap.state._replace(elevation=elevation, validity=known), emap.cfg)
