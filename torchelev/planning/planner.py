"""Plan local paths on the grid of a map."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_positive
from torchelev.inputs.checks import FLOATS, check_tensor, given_or_default
from torchelev.ops.transforms import is_readable
from torchelev.planning.cost_to_go import cost_to_go, descend
from torchelev.planning.path_reason import Endpoint, explain, find_limit, find_reason, read_cell
from torchelev.planning.standing import mark_standing_cells
from torchelev.planning.traversal_cost import (
    TraversalCostConfig,
    cost_within,
    find_obstruction,
    mark_disc,
    widen,
)
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class Path(NamedTuple):
    """A path of at most K waypoints, the centres of cells, on each of B maps."""

    xy: Float[Tensor, "B K 2"]  #: [m] map frame, from the start on; the last waypoint is repeated
    cost: Float[Tensor, "B"]  #: length [m] of a path of equal cost over ground of cost 1; inf if there is no path
    length: Float[Tensor, "B"]  #: [m]
    reached: Bool[Tensor, "B"]  #: the path ends at the goal
    #: number of waypoints without the repeated ones; 0 if the start is outside the window
    count: Int[Tensor, "B"]  # type: ignore[assignment]
    reason: Int[Tensor, "B"]  #: why the path ends where it does, a `Reason`; `explain` puts it into words
    limit: Int[Tensor, "B"]  #: the `limits.Limit` that makes the ground there impassable, if any

    def poses(self, chord: float = 0.4) -> Float[Tensor, "B K 3"]:
        """Return x, y [m] and yaw [rad] of each waypoint, for `check_path`.

        The yaw is the direction of the path from `chord` / 2 behind the waypoint to `chord` / 2 ahead of it, as single
        steps turn by 45 degrees at a time; a path of one waypoint has yaw 0. The last waypoint's pose is repeated. The
        turn from the robot's present heading to the first yaw is not included.

        Where no path was found (`cost` is inf), all poses are NaN: an empty path, which `check_path` rates as not safe.
        A path longer than `max_cells` has poses up to its last waypoint, short of the goal: test `reached`, too.

        Args:
            chord: length of the path over which its direction is taken [m].

        Raises:
            ValueError: unless `chord` is positive.
        """
        require_positive(chord=chord)
        steps = torch.linalg.vector_norm(self.xy[:, 1:] - self.xy[:, :-1], dim=-1)
        travelled = torch.nn.functional.pad(steps.cumsum(1), (1, 0))
        last = (self.count - 1).clamp(min=0)[:, None]
        ahead = torch.searchsorted(travelled, travelled + chord / 2).minimum(last)
        behind = (torch.searchsorted(travelled, travelled - chord / 2, right=True) - 1).clamp(min=0)
        end, begin = (self.xy.gather(1, k[..., None].expand(-1, -1, 2)) for k in (ahead, behind))
        x, y = (end - begin).unbind(-1)
        poses = torch.cat([self.xy, torch.atan2(y, x)[..., None]], -1)
        waypoint = torch.arange(self.xy.shape[1], device=last.device).minimum(last)
        poses = poses.gather(1, waypoint[..., None].expand(-1, -1, 3))
        return torch.where(torch.isfinite(self.cost)[:, None, None], poses, torch.nan)

    def explain(self) -> list[str]:
        """Return each `reason`, and the `limit`, as a sentence. The host waits for the device."""
        return [explain(*codes) for codes in zip(self.reason.tolist(), self.limit.tolist(), strict=True)]


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
    """Find the cheapest path from start to goal over the cells of each map, by `traversal_cost`.

    No path leads over ground beyond the robot's step, slope or clearance (`planning.limits`), whatever its rating, nor
    over ground of a class that `TraversalCostConfig.class_costs` forbids.
    The cell of the start is passable even if it is rated impassable: a robot may leave such ground, and `check_path`
    reports it. Cells of unknown traversability below the robot are passable too (`torchelev.planning.standing`).

    Args:
        emap: the maps.
        start_xy: where the robots stand [m], map frame.
        goal_xy: where they should go [m], map frame.
        cfg: thresholds and weights of the cost.
        confidence: confidence of the traversability, 0 to 1; None: that of the learned head, else 1.
        max_cells: K, the largest number of waypoints; None: 2 (H + W). Of a longer path the first K waypoints are
            returned, and `reached` is False.
        rounds: the largest number of rounds of `cost_to_go`.
        standing: footprints on which the robots stand now [m], map frame (`standing.place_footprint`). Give the same to
            `check_path`. None: a disc of radius `stand_radius` around the start.
        state: the state to read; None: that of the maps.

    Raises:
        ValueError, TypeError: for a wrong shape, dtype or device. On a CPU, or with the map's `check_values`, also for
            a start or goal outside the window or not finite; elsewhere, where reading them would make the host wait,
            the path does not reach its goal.
        KeyError: for a channel or class of `class_costs` that the map lacks.
    """
    cfg, grid = given_or_default(TraversalCostConfig, cfg), emap.cfg.grid
    current = emap.state if state is None else state
    start, goal = (_find_cell(emap, *point, current) for point in (("start_xy", start_xy), ("goal_xy", goal_xy)))
    max_cells = 2 * (grid.height + grid.width) if max_cells is None else max_cells
    found = find_obstruction(emap, cfg, state)
    cost = cost_within(found, emap, cfg, confidence=confidence, start=start.cell, standing=standing, state=state)
    target = mark_disc(goal.cell, cost, 0.0) & (start.is_inside & goal.is_inside)[:, None, None]
    value = cost_to_go(cost, target, resolution=grid.resolution, rounds=rounds)
    path = descend(value, cost, start.cell, resolution=grid.resolution, max_cells=max_cells)
    reached = path.reached & start.is_inside
    if is_readable(reached) and bool(reached.all()):  # there is nothing to explain
        reason, limit = (torch.zeros_like(path.cells[:, 0, 0]) for _ in range(2))
    else:
        rated = emap.read_layer("traversability", state)[1]
        radius = cfg.stand_radius / grid.resolution
        below = mark_disc(start.cell, cost, radius) if standing is None else mark_standing_cells(emap, standing, state)
        reason = find_reason(cost, value, rated, below, start, goal, reached)
        wide = [widen(cells, round(cfg.inflation_radius / grid.resolution)) for cells in found.exceeded]
        limit = find_limit(reason, cost, value, wide, below, start, goal)
    xy = (path.cells + current.corner[:, None]).double().add(0.5) * grid.resolution
    num_steps = (path.cells[:, 1:] != path.cells[:, :-1]).any(-1).sum(1)
    count = torch.where(start.is_inside, num_steps + 1, 0)
    start_value = torch.where(start.is_inside, read_cell(value, start.cell), torch.inf)
    return Path(xy, start_value, path.length, reached, count, reason, limit)


def _find_cell(emap: ElevationMap, name: str, xy: object, state: MapState) -> Endpoint:
    """Check points (B, 2) and return their cells."""
    value, grid = check_tensor(name, xy, emap.device, FLOATS), emap.cfg.grid
    shape = (emap.num_envs, 2)
    require(tuple(value.shape) == shape, name, f"expected {shape}", tuple(value.shape), "give one point for each map")
    cell = torch.floor(value.detach().double() / grid.resolution) - state.corner
    i, j = cell.unbind(-1)
    is_inside = (cell >= 0).all(-1) & (i < grid.height) & (j < grid.width)
    if is_readable(value, emap.check_values):
        actual = [[round(x, 3) for x in point] for point in value.detach()[~is_inside].tolist()[:3]]
        hint = f"windows are {grid.length_x:g} x {grid.length_y:g} m around emap.center; give a point inside"
        require(bool(is_inside.all()), name, "must lie in the window", actual, hint)
    return Endpoint(torch.where(is_inside[:, None], cell, 0.0).to(torch.int64), is_inside)
