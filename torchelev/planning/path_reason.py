"""Why a plan does not reach its goal."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.ops.windows import AROUND, neighbours
from torchelev.planning.limits import Limit
from torchelev.planning.traversal_cost import mark_disc

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class Reason(IntEnum):
    """The reason why a path ends. `sentence` puts it into words, with the likely remedy."""

    REACHED = 0
    START_OUTSIDE = 1
    GOAL_OUTSIDE = 2
    GOAL_UNKNOWN = 3
    GOAL_IMPASSABLE = 4
    START_UNKNOWN = 5
    START_IMPASSABLE = 6
    ROUND_LIMIT = 7
    NO_PATH = 8
    CELL_LIMIT = 9

    @property
    def sentence(self) -> str:
        """The reason in words."""
        return _SENTENCES[self]


_SENTENCES = {
    Reason.REACHED: "the path reaches the goal",
    Reason.START_OUTSIDE: "the start is outside the window or not finite; recenter the map on the robot",
    Reason.GOAL_OUTSIDE: "the goal is outside the window or not finite; give a goal inside the window",
    Reason.GOAL_UNKNOWN: "the traversability at the goal is unknown and its upper bound is steep or unknown, "
    "or the goal is too close to impassable ground; give a goal on ground that was measured",
    Reason.GOAL_IMPASSABLE: "the ground at the goal is rated impassable, or is too close to impassable ground "
    "or to unknown cells that may be a step",
    Reason.START_UNKNOWN: "no ground around the robot is passable, and some of it is unknown; "
    "measure it, or initialize the map around the feet",
    Reason.START_IMPASSABLE: "all ground around the robot is rated impassable",
    Reason.ROUND_LIMIT: "the search ended after its last round, before it reached the start; raise rounds",
    Reason.NO_PATH: "impassable or unknown ground separates the start from the goal",
    Reason.CELL_LIMIT: "the path is longer than max_cells; raise it, or plan again from the end of the path",
}


_LIMITS = {
    Limit.NONE: "",
    Limit.STEP: "; there, steps are higher than the robot can overcome",
    Limit.SLOPE: "; there, the ground is steeper than the robot can climb",
    Limit.CLEARANCE: "; there, the ground would touch the robot's belly",
    Limit.CLASS: "; there, the ground is too likely of a class that class_costs forbids",
    Limit.CEILING: "; there, what hangs above the ground is lower than the robot is high",
}


def explain(reason: int, limit: int) -> str:
    """Return a reason, and the limit that is part of it, as a sentence."""
    return Reason(reason).sentence + _LIMITS[Limit(limit)]


class Endpoint(NamedTuple):
    """The start or the goal of a path on each of B maps."""

    cell: Int[Tensor, "B 2"]  #: (i, j); (0, 0) if outside the window
    is_inside: Bool[Tensor, "B"]  #: the point lies inside the window


def find_reason(
    cost: Float[Tensor, "B H W"],
    value: Float[Tensor, "B H W"],
    rated: Bool[Tensor, "B H W"],
    standing: Bool[Tensor, "B H W"],
    start: Endpoint,
    goal: Endpoint,
    reached: Bool[Tensor, "B"],
) -> Int[Tensor, "B"]:
    """Return the `Reason` of each map, int64, without waiting for the device.

    Args:
        cost: the cost of each cell, as `traversal_cost` returns it.
        value: the cost to go.
        rated: the cells of known traversability.
        standing: the cells below the robot.
        start: the start of the path.
        goal: the goal of the path.
        reached: whether the path ends at the goal.
    """
    is_passable = torch.isfinite(cost)
    around = _mark_border(standing | mark_disc(start.cell, cost, 0.0))
    masks = (around, around & is_passable, around & ~rated)
    has_border, has_exit, has_unknown = (mask.flatten(1).any(1) for mask in masks)
    is_enclosed = has_border & ~has_exit  # without a border, the robot fills the window
    is_blocked, is_rated = ~read_cell(is_passable, goal.cell), read_cell(rated, goal.cell)
    # From the most general reason to the most specific one.
    reason = torch.full_like(start.cell[:, 0], Reason.NO_PATH)
    for holds, specific in (
        (_can_spread(value, is_passable), Reason.ROUND_LIMIT),
        (is_enclosed & ~has_unknown, Reason.START_IMPASSABLE),
        (is_enclosed & has_unknown, Reason.START_UNKNOWN),
        (torch.isfinite(read_cell(value, start.cell)), Reason.CELL_LIMIT),
        (is_blocked & is_rated, Reason.GOAL_IMPASSABLE),
        (is_blocked & ~is_rated, Reason.GOAL_UNKNOWN),
        (~goal.is_inside, Reason.GOAL_OUTSIDE),
        (~start.is_inside, Reason.START_OUTSIDE),
        (reached, Reason.REACHED),
    ):
        reason = torch.where(holds, specific.value, reason)
    return reason


def find_limit(
    reason: Int[Tensor, "B"],
    cost: Float[Tensor, "B H W"],
    value: Float[Tensor, "B H W"],
    exceeded: Sequence[Bool[Tensor, "B H W"]],
    standing: Bool[Tensor, "B H W"],
    start: Endpoint,
    goal: Endpoint,
) -> Int[Tensor, "B"]:
    """Return the `Limit` that the most ground exceeds where a path ends, int64.

    This ground is the goal, what encloses the start, or the border of what can be reached from the goal.

    Args:
        reason: the `Reason` of each map.
        cost: the cost of each cell, as `traversal_cost` returns it.
        value: the cost to go.
        exceeded: the cells that exceed each limit, and those too close to them.
        standing: the cells below the robot.
        start: the start of the path.
        goal: the goal of the path.
    """
    around = _mark_border(standing | mark_disc(start.cell, cost, 0.0))
    border = torch.zeros_like(around)
    for reasons, cells in (
        ((Reason.NO_PATH,), _mark_border(torch.isfinite(value))),
        ((Reason.START_UNKNOWN, Reason.START_IMPASSABLE), around),
        ((Reason.GOAL_UNKNOWN, Reason.GOAL_IMPASSABLE), mark_disc(goal.cell, cost, 0.0)),
    ):
        holds = functools.reduce(torch.logical_or, (reason == which.value for which in reasons))
        border = border | (cells & torch.isinf(cost) & holds[:, None, None])
    counts = torch.stack([(border & cells).flatten(1).sum(1) for cells in exceeded])
    most, which = counts.max(0)
    return torch.where(most > 0, which + Limit.STEP.value, Limit.NONE.value)


def read_cell(layer: Tensor, cell: Int[Tensor, "B 2"]) -> Tensor:
    """Return the value at cell (i, j) of each map."""
    return layer.flatten(1).gather(1, cell[:, :1] * layer.shape[2] + cell[:, 1:])[:, 0]


def _mark_border(cells: Bool[Tensor, "B H W"]) -> Bool[Tensor, "B H W"]:
    """Mark the straight neighbours of cells. Diagonal ones cannot be reached alone, as no step cuts a corner."""
    return (_neighbour_minimum(torch.where(cells, 0.0, 1.0), 1.0) == 0) & ~cells


def _can_spread(value: Float[Tensor, "B H W"], is_passable: Bool[Tensor, "B H W"]) -> Bool[Tensor, "B"]:
    """Return whether the search stopped early: some passable cell without a value has a neighbour with one."""
    nearest = _neighbour_minimum(value, torch.inf)
    return (torch.isinf(value) & is_passable & torch.isfinite(nearest)).flatten(1).any(1)


def _neighbour_minimum(values: Tensor, fill: float) -> Tensor:
    """Return the minimum over the four straight neighbours of each cell."""
    straight = [v for (i, j), v in zip(AROUND, neighbours(values, fill), strict=True) if i == 0 or j == 0]
    return functools.reduce(torch.minimum, straight)
