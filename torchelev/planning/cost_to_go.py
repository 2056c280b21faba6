"""The cost to go from every cell of a map to a goal, and the descent along it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import require, require_count, require_positive
from torchelev.inputs.checks import FLOATS, require_indices, require_tensor
from torchelev.ops.transforms import is_readable
from torchelev.ops.windows import AROUND, neighbours
from torchelev.planning.solvers import dijkstra
from torchelev.planning.solvers.sweeps import iterate, step_cost

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_DEFAULT_ROUNDS = 16  # off the CPU, where testing for convergence would make the host wait


def cost_to_go(
    cost: Float[Tensor, "B H W"], goal: Bool[Tensor, "B H W"], *, resolution: float, rounds: int | None = None
) -> Float[Tensor, "B H W"]:
    """Compute the cost of the cheapest path from each cell to a goal cell.

    J(a) = min over the eight neighbours b of J(b) + |ab| (c_a + c_b) / 2, with J = 0 at passable goal cells. A diagonal
    step requires the two cells beside it to be passable: no path cuts a corner.

    On a CPU by Dijkstra's algorithm in C++ (`solvers.dijkstra`). Elsewhere, with `rounds` or without a compiler, by
    value iteration (`solvers.sweeps`), with the same result: a round sweeps over the rows forwards and backwards, then
    over the columns, and each line uses the values just computed for the one before it. A sweep follows every path that
    keeps to its direction to the end, so the rounds needed grow with the turns of a path, not with its cells. Not
    differentiable.

    Args:
        cost: c, the cost of each metre in a cell: positive, inf where impassable.
        goal: the cells to reach.
        resolution: side of a cell [m].
        rounds: the largest number of rounds; None: on a CPU as many as are needed, elsewhere 16, as a test for
            convergence would make the host wait. Cells that these rounds do not reach stay inf, and a path may not be
            the cheapest.

    Returns:
        J, at least in float32: the length [m] of a path of equal cost over ground of cost 1; inf where there is no
        path.

    Raises:
        ValueError, TypeError: for a wrong shape or dtype and, on a CPU, for costs that are not positive.
    """
    _check_grids(cost, goal)
    require_positive(resolution=resolution)
    if rounds is not None:
        require_count("rounds", rounds, "give 16, or None")
    can_read = is_readable(cost)
    if can_read:
        hint = "give 1 for easy ground and inf for impassable"
        require(bool((cost > 0).all()), "cost", "must be positive", "NaN, or 0 and less", hint)
    with torch.no_grad():
        cost = _at_least_float32(cost.detach())
        value = dijkstra.find_costs(cost, goal, resolution) if rounds is None else None
        max_rounds = rounds or (cost.shape[1] * cost.shape[2] + 1 if can_read else _DEFAULT_ROUNDS)
        return iterate(cost, goal, resolution, max_rounds, until_convergence=can_read) if value is None else value


def _at_least_float32(cost: Tensor) -> Tensor:
    """Convert half precision, which cannot sum the costs of a path, to float32."""
    return cost.to(torch.promote_types(cost.dtype, torch.float32))


def _check_grids(cost: object, goal: object) -> None:
    cost, goal = require_tensor("cost", cost), require_tensor("goal", goal)
    require(cost.dtype in FLOATS, "cost", "must be floats", cost.dtype, "convert it with .to(torch.float32)", TypeError)
    require(cost.ndim == 3, "cost", "expected (B, H, W)", tuple(cost.shape), "add the dimension of the maps")
    hint = "convert it with goal > 0"
    require(goal.dtype == torch.bool, "goal", "must be bool", goal.dtype, hint, TypeError)
    require(goal.shape == cost.shape, "goal", f"expected {tuple(cost.shape)}", tuple(goal.shape), "mark cells of cost")


class Descent(NamedTuple):
    """A path of at most K cells on each of B maps."""

    cells: Int[Tensor, "B K 2"]  #: (i, j), from the start on; the last one is repeated
    length: Float[Tensor, "B"]  #: [m]
    reached: Bool[Tensor, "B"]  #: the path ends at the goal


def descend(
    value: Float[Tensor, "B H W"],
    cost: Float[Tensor, "B H W"],
    start: Int[Tensor, "B 2"],
    *,
    resolution: float,
    max_cells: int,
) -> Descent:
    """Follow the cost to go from a start cell to the goal.

    The next cell is the neighbour b that attains the minimum in `cost_to_go`. Where no goal can be reached, the path
    stays at its start.

    Args:
        value: the cost to go, as `cost_to_go` returns it.
        cost: the costs that it was computed from.
        start: cell (i, j) of each map.
        resolution: side of a cell [m].
        max_cells: K, the largest number of cells of a path.

    Raises:
        ValueError: for a wrong shape and, on a CPU, for a start outside the map.
    """
    require_count("max_cells", max_cells, "give 500")
    B, H, W = cost.shape
    fits = tuple(value.shape) == (B, H, W)
    require(fits, "value", f"expected {(B, H, W)}", tuple(value.shape), "give what cost_to_go returns")
    hint = "give one cell, i and j, for each map"
    require(tuple(start.shape) == (B, 2), "start", f"expected {(B, 2)}", tuple(start.shape), hint)
    for axis, size in enumerate((H, W)):
        require_indices("start", start[:, axis], size, "give cells of the map")
    value, cost = _at_least_float32(value), _at_least_float32(cost)
    first = start[:, :1] * W + start[:, 1:]
    cell = dijkstra.follow(value, cost, first, resolution, max_cells)
    cell = _follow(_next_cells(value, cost, resolution), first, max_cells) if cell is None else cell
    cells = torch.stack([torch.div(cell, W, rounding_mode="floor"), cell % W], -1)
    length = (cells[:, 1:] - cells[:, :-1]).to(cost.dtype).norm(dim=-1).sum(1) * resolution
    return Descent(cells, length, value.flatten(1).gather(1, cell[:, -1:])[:, 0] == 0)


def _follow(following: Int[Tensor, "B H*W"], first: Int[Tensor, "B 1"], max_cells: int) -> Int[Tensor, "B K"]:
    """Return the numbers of the cells of each path, of which each cell names the next."""
    path = [first]
    for _ in range(max_cells - 1):
        path.append(following.gather(1, path[-1]))
    return torch.cat(path, 1)


def _next_cells(value: Tensor, cost: Tensor, resolution: float) -> Int[Tensor, "B H*W"]:
    """Return the cell number of the next cell on the path from each cell; its own at the goal and without a path."""
    B, H, W = cost.shape
    values, costs = neighbours(value, torch.inf), neighbours(cost, torch.inf)
    cost_at = dict(zip(AROUND, costs, strict=True))
    best, step = torch.full_like(value, torch.inf), torch.zeros(B, H, W, device=cost.device, dtype=torch.int64)
    for (i, j), v, c in zip(AROUND, values, costs, strict=True):
        total = v + step_cost(cost, c, math.hypot(i, j) * resolution)
        if i and j:
            total = torch.where(torch.isinf(cost_at[i, 0] + cost_at[0, j]), torch.inf, total)
        step = torch.where(total < best, i * W + j, step)
        best = torch.minimum(best, total)
    step = torch.where(value > 0, step, 0)
    return (step + torch.arange(H * W, device=cost.device).view(H, W)).flatten(1)
