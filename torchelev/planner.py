"""Local paths over a map."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.checks import FLOATS, check_tensor, given_or_default, readable
from torchelev.cost_to_go import cost_to_go, descend
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.state import MapState
from torchelev.traversal_cost import TraversalCostConfig, traversal_cost

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class Path(NamedTuple):
    """A way of at most K cells on each of B maps."""

    xy: Float[Tensor, "B K 2"]  # [m] map frame, from the start on; the last place is repeated, the start if no way is
    cost: Float[Tensor, "B"]  # [m] of easy ground that cost as much; inf if there is no way
    length: Float[Tensor, "B"]  # [m]
    reached: Bool[Tensor, "B"]  # it ends at the goal


def plan(
    emap: ElevationMap,
    start_xy: Float[Tensor, "B 2"],
    goal_xy: Float[Tensor, "B 2"],
    cfg: TraversalCostConfig | None = None,
    *,
    confidence: Float[Tensor, "B H W"] | None = None,
    max_cells: int | None = None,
    rounds: int | None = None,
    state: MapState | None = None,
) -> Path:
    """Find the cheapest way over each map from cell to cell, by `traversal_cost`.

    The start's cell is passable, as is unknown ground around it (`stand_radius`).

    Args:
        emap: the maps.
        start_xy: where the robots stand [m], map frame.
        goal_xy: where they should go [m], map frame.
        cfg: thresholds and weights.
        confidence: of the traversability, 0 to 1; None: the learned head's own, else 1.
        max_cells: K, of the longest way; None: twice the cells along x and y together. Of a longer way the first K
            cells come back, and `reached` is False.
        rounds: as of `cost_to_go`.
        state: of the maps; None: their own.

    Raises ValueError or TypeError for wrong shapes, dtypes and devices. Places outside of the window or not finite are
    refused on a CPU; on other devices they are not reached, unless the map has `check_values`.
    """
    cfg, grid = given_or_default(TraversalCostConfig, cfg), emap.cfg.grid
    current = emap.state if state is None else state
    (start, starts), (goal, ends) = (
        _cell(emap, *place, current) for place in (("start_xy", start_xy), ("goal_xy", goal_xy))
    )
    longest = 2 * (grid.height + grid.width) if max_cells is None else max_cells
    cost = traversal_cost(emap, cfg, confidence=confidence, start=start, state=state)
    value = cost_to_go(cost, _mark(goal, starts & ends, cost), resolution=grid.resolution, rounds=rounds)
    way = descend(value, cost, start, resolution=grid.resolution, max_cells=longest)
    at_start = value.flatten(1).gather(1, (start[:, :1] * grid.width + start[:, 1:]))[:, 0]
    xy = (way.cells + current.corner[:, None]).double().add(0.5) * grid.resolution
    return Path(xy, torch.where(starts, at_start, torch.inf), way.length, way.reached & starts)


def _cell(emap: ElevationMap, name: str, xy: object, state: MapState) -> tuple[Tensor, Tensor]:
    """Return the cell (B, 2) of each place, the first one if it lies outside, and whether it lies inside."""
    value, grid = check_tensor(name, xy, emap.device, FLOATS), emap.cfg.grid
    shape = (emap.num_envs, 2)
    require(tuple(value.shape) == shape, name, f"expected {shape}", tuple(value.shape), "give one place for each map")
    cell = torch.floor(value.detach().double() / grid.resolution) - state.corner
    low, (i, j) = (cell >= 0).all(-1), cell.unbind(-1)
    inside = low & (i < grid.height) & (j < grid.width)
    if readable(value, emap.check_values):
        came = [[round(x, 3) for x in place] for place in value.detach()[~inside].tolist()[:3]]
        mend = f"windows are {grid.length_x:g} x {grid.length_y:g} m around emap.center; give a place in between"
        require(bool(inside.all()), name, "must lie in the window", came, mend)
    return torch.where(inside[:, None], cell, 0.0).to(torch.int64), inside


def _mark(cell: Int[Tensor, "B 2"], there: Bool[Tensor, "B"], like: Tensor) -> Bool[Tensor, "B H W"]:
    """Return a mask of one cell of each map, or of none."""
    i, j = (torch.arange(size, device=like.device) for size in like.shape[1:])
    return (i[None, :, None] == cell[:, 0, None, None]) & (j == cell[:, 1, None, None]) & there[:, None, None]
