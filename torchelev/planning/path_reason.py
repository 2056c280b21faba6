"""Why a plan does not reach its goal."""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.ops.windows import AROUND, neighbours
from torchelev.planning.traversal_cost import disc

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class Reason(IntEnum):
    """Why a path ends where it does. `sentence` says it, with the likely remedy."""

    REACHED = 0
    START_OUTSIDE = 1
    GOAL_OUTSIDE = 2
    GOAL_UNKNOWN = 3
    GOAL_IMPASSABLE = 4
    START_UNKNOWN = 5
    START_IMPASSABLE = 6
    ROUNDS = 7
    NO_WAY = 8
    STEP_LIMIT = 9

    @property
    def sentence(self) -> str:
        """The reason in words."""
        return _SENTENCES[self]


_SENTENCES = {
    Reason.REACHED: "the path reaches the goal",
    Reason.START_OUTSIDE: "the start is outside of the window or not finite; recenter the map on the robot",
    Reason.GOAL_OUTSIDE: "the goal is outside of the window or not finite; give a goal within the window",
    Reason.GOAL_UNKNOWN: "the goal's traversability is unknown, and no gentle bound vouches for it, "
    "or it is too close to impassable ground; give a goal on ground that was seen",
    Reason.GOAL_IMPASSABLE: "the ground at the goal is rated impassable, or too close to impassable ground",
    Reason.START_UNKNOWN: "no ground around the place where the robot stands is passable, and some of it is unknown; "
    "look at it, or initialize the map around the feet",
    Reason.START_IMPASSABLE: "all ground around the place where the robot stands is rated impassable",
    Reason.ROUNDS: "the search stopped after its last round before it reached the start; raise rounds",
    Reason.NO_WAY: "impassable or unknown ground separates the start from the goal",
    Reason.STEP_LIMIT: "the path is longer than max_cells; raise it, or plan again from the path's end",
}


def find_reason(
    cost: Float[Tensor, "B H W"],
    value: Float[Tensor, "B H W"],
    rated: Bool[Tensor, "B H W"],
    standing: Bool[Tensor, "B H W"],
    ends: tuple[tuple[Int[Tensor, "B 2"], Bool[Tensor, "B"]], tuple[Int[Tensor, "B 2"], Bool[Tensor, "B"]]],
    reached: Bool[Tensor, "B"],
) -> Int[Tensor, "B"]:
    """Return the `Reason` of each map, int64, without reading values.

    Args:
        cost: of each cell, `traversal_cost`.
        value: the cost to go.
        rated: cells of known traversability.
        standing: cells under the robot.
        ends: the cells (i, j) of the start and of the goal, and whether each lies in the window.
        reached: the path ends at the goal.
    """
    (start, starts), (goal, goals) = ends
    passable = torch.isfinite(cost)
    around = _around(standing | disc(start, cost, 0.0))
    some, free, unseen = (mask.flatten(1).any(1) for mask in (around, around & passable, around & ~rated))
    caged = some & ~free  # the robot may fill a small window
    reason = torch.where(_unfinished(value, passable), Reason.ROUNDS.value, torch.full_like(start[:, 0], Reason.NO_WAY))
    reason = torch.where(caged & ~unseen, Reason.START_IMPASSABLE.value, reason)
    reason = torch.where(caged & unseen, Reason.START_UNKNOWN.value, reason)
    reason = torch.where(torch.isfinite(at(value, start)), Reason.STEP_LIMIT.value, reason)
    blocked, rating = ~at(passable, goal), at(rated, goal)
    reason = torch.where(blocked & rating, Reason.GOAL_IMPASSABLE.value, reason)
    reason = torch.where(blocked & ~rating, Reason.GOAL_UNKNOWN.value, reason)
    reason = torch.where(goals, reason, Reason.GOAL_OUTSIDE.value)
    reason = torch.where(starts, reason, Reason.START_OUTSIDE.value)
    return torch.where(reached, Reason.REACHED.value, reason)


def at(layer: Tensor, cell: Int[Tensor, "B 2"]) -> Tensor:
    """Return what one cell of each map holds."""
    return layer.flatten(1).gather(1, cell[:, :1] * layer.shape[2] + cell[:, 1:])[:, 0]


def _around(cells: Bool[Tensor, "B H W"]) -> Bool[Tensor, "B H W"]:
    """Mark the cells beside those marked. No step cuts a corner, so that the diagonal neighbours do not count."""
    return (_beside(torch.where(cells, 0.0, 1.0), 1.0) == 0) & ~cells


def _unfinished(value: Float[Tensor, "B H W"], passable: Bool[Tensor, "B H W"]) -> Bool[Tensor, "B"]:
    """Tell whether the search can still spread: a passable cell without a value is beside one that has one."""
    nearest = _beside(value, torch.inf)
    return (torch.isinf(value) & passable & torch.isfinite(nearest)).flatten(1).any(1)


def _beside(values: Tensor, fill: float) -> Tensor:
    """Return the least value of each cell's four straight neighbours."""
    straight = [v for (i, j), v in zip(AROUND, neighbours(values, fill), strict=True) if i == 0 or j == 0]
    return torch.stack(straight).amin(0)
