"""Local paths over a map."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.checks import FLOATS, check_tensor, given_or_default, readable
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_positive
from torchelev.planning.cost_to_go import cost_to_go, descend
from torchelev.planning.path_reason import Reason, at, find_reason
from torchelev.planning.standing import standing_cells
from torchelev.planning.traversal_cost import TraversalCostConfig, disc, traversal_cost
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class Path(NamedTuple):
    """A path of at most K cells on each of B maps."""

    xy: Float[Tensor, "B K 2"]  #: [m] map frame, from the start on; the last waypoint is repeated
    cost: Float[Tensor, "B"]  #: [m] of easy ground that cost as much; inf if there is no way
    length: Float[Tensor, "B"]  #: [m]
    reached: Bool[Tensor, "B"]  #: it ends at the goal
    #: waypoints before the repeats; 0 if the start is outside
    count: Int[Tensor, "B"]  # type: ignore[assignment]
    reason: Int[Tensor, "B"]  #: why it is not reached: a `Reason`; `explain` puts it into words

    def poses(self, chord: float = 0.4) -> Float[Tensor, "B K 3"]:
        """Return x, y [m] and yaw [rad] of each waypoint, as `check_path` takes them.

        The yaw is the direction from `chord` / 2 [m] behind to as far ahead along the path, as far as it goes: single
        cells turn by 45 degrees at a time. The last waypoint's pose is repeated like its place. The yaw is 0 where
        there is only one waypoint. How the robot turns from where it looks now to the first yaw is not part of it. Ask
        `reached` first: where it is False, `check_path` checks the poses up to where the path ends.

        Raises ValueError unless `chord` is positive.
        """
        require_positive(chord=chord)
        steps = torch.linalg.vector_norm(self.xy[:, 1:] - self.xy[:, :-1], dim=-1)
        along = torch.nn.functional.pad(steps.cumsum(1), (1, 0))
        last = (self.count - 1).clamp(min=0)[:, None]
        ahead = torch.searchsorted(along, along + chord / 2).minimum(last)
        behind = (torch.searchsorted(along, along - chord / 2, right=True) - 1).clamp(min=0)
        to, since = (self.xy.gather(1, k[..., None].expand(-1, -1, 2)) for k in (ahead, behind))
        x, y = (to - since).unbind(-1)
        poses = torch.cat([self.xy, torch.atan2(y, x)[..., None]], -1)
        waypoint = torch.arange(self.xy.shape[1], device=last.device).minimum(last)
        return poses.gather(1, waypoint[..., None].expand(-1, -1, 3))

    def explain(self) -> list[str]:
        """Return each `reason` as a sentence. The host waits for the device."""
        return [Reason(code).sentence for code in self.reason.tolist()]


def plan(
    emap: ElevationMap,
    start_xy: Float[Tensor, "B 2"],
    goal_xy: Float[Tensor, "B 2"],
    cfg: TraversalCostConfig | None = None,
    *,
    confidence: Float[Tensor, "B H W"] | None = None,
    max_cells: int | None = None,
    rounds: int | None = None,
    standing: Float[Tensor, "B V 2"] | None = None,
    state: MapState | None = None,
) -> Path:
    """Find the cheapest way over each map from cell to cell, by `traversal_cost`.

    The start's cell is passable, even if it is rated impassable: a robot may leave such ground, and `check_path` tells
    of it. Unknown ground under the robot where it stands now is passable too (see `torchelev.planning.standing`).

    Args:
        emap: the maps.
        start_xy: where the robots stand [m], map frame.
        goal_xy: where they should go [m], map frame.
        cfg: thresholds and weights.
        confidence: of the traversability, 0 to 1; None: the learned head's own, else 1.
        max_cells: K, of the longest way; None: twice the cells along x and y together. Of a longer way the first K
            cells come back, and `reached` is False.
        rounds: as of `cost_to_go`.
        standing: footprints on which the robots stand now [m], map frame (`standing.place_footprint`): give the same to
            `check_path`. None: a disc of `stand_radius` around the start.
        state: of the maps; None: their own.

    Raises ValueError or TypeError for wrong shapes, dtypes and devices. Places outside of the window or not finite are
    refused on a CPU; on other devices they are not reached, unless the map has `check_values`.
    """
    cfg, grid = given_or_default(TraversalCostConfig, cfg), emap.cfg.grid
    current = emap.state if state is None else state
    start, starts = _cell(emap, "start_xy", start_xy, current)
    goal, goals = _cell(emap, "goal_xy", goal_xy, current)
    longest = 2 * (grid.height + grid.width) if max_cells is None else max_cells
    cost = traversal_cost(emap, cfg, confidence=confidence, start=start, standing=standing, state=state)
    target = disc(goal, cost, 0.0) & (starts & goals)[:, None, None]
    value = cost_to_go(cost, target, resolution=grid.resolution, rounds=rounds)
    way = descend(value, cost, start, resolution=grid.resolution, max_cells=longest)
    reached = way.reached & starts
    rated = emap.read_layer("traversability", state)[1]
    radius = cfg.stand_radius / grid.resolution
    below = disc(start, cost, radius) if standing is None else standing_cells(emap, standing, state)
    reason = find_reason(cost, value, rated, below, ((start, starts), (goal, goals)), reached)
    xy = (way.cells + current.corner[:, None]).double().add(0.5) * grid.resolution
    moves = (way.cells[:, 1:] != way.cells[:, :-1]).any(-1).sum(1)
    count = torch.where(starts, moves + 1, 0)
    return Path(xy, torch.where(starts, at(value, start), torch.inf), way.length, reached, count, reason)


def _cell(emap: ElevationMap, name: str, xy: object, state: MapState) -> tuple[Tensor, Tensor]:
    """Return the cell (B, 2) of each place, the first one if it lies outside, and whether it lies inside."""
    value, grid = check_tensor(name, xy, emap.device, FLOATS), emap.cfg.grid
    shape = (emap.num_envs, 2)
    require(tuple(value.shape) == shape, name, f"expected {shape}", tuple(value.shape), "give one place for each map")
    cell = torch.floor(value.detach().double() / grid.resolution) - state.corner
    low, (i, j) = (cell >= 0).all(-1), cell.unbind(-1)
    inside = low & (i < grid.height) & (j < grid.width)
    if readable(value, emap.check_values):
        actual = [[round(x, 3) for x in place] for place in value.detach()[~inside].tolist()[:3]]
        hint = f"windows are {grid.length_x:g} x {grid.length_y:g} m around emap.center; give a place in between"
        require(bool(inside.all()), name, "must lie in the window", actual, hint)
    return torch.where(inside[:, None], cell, 0.0).to(torch.int64), inside
