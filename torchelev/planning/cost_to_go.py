"""The cost to go to a goal from every cell of a map, and the way down along it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.checks import FLOATS, readable, require_indices, require_tensor
from torchelev.errors import require, require_count, require_positive
from torchelev.ops.windows import AROUND, neighbours

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

ROUNDS = 16  # where the host must not look whether more are needed


class _Steps(NamedTuple):
    """What it costs to go from each of L lines of N cells to the next, on B maps; the same backwards."""

    straight: Float[Tensor, "L-1 B N"]  # from (l, n) to (l + 1, n)
    rising: Float[Tensor, "L-1 B N-1"]  # from (l, n) to (l + 1, n + 1)
    falling: Float[Tensor, "L-1 B N-1"]  # from (l, n + 1) to (l + 1, n)


def cost_to_go(
    cost: Float[Tensor, "B H W"], goal: Bool[Tensor, "B H W"], *, resolution: float, rounds: int | None = None
) -> Float[Tensor, "B H W"]:
    """Return what the cheapest way from each cell to a goal cell costs [m of easy ground], inf if there is none.

    J(a) = min over the eight neighbours b of J(b) + |ab| (c_a + c_b) / 2, with J = 0 at the goal cells that are
    passable. A diagonal step needs the two cells beside it too: no corner is cut. The costs c are positive, inf where
    impassable.

    Value iteration, line by line: a round goes over the lines of the map ahead, back, left and right, and each line
    takes what the one before it has just got. So each of these passes follows all ways that keep to its direction,
    straight or aslant, to their end; a round is needed for every turn, where going from all cells at once takes one for
    every cell of the longest way. No gradient.

    Args:
        cost: of each metre.
        goal: the cells to reach.
        resolution: [m].
        rounds: at most so many; None: on a CPU until nothing changes, elsewhere 16, as looking would make the host
            wait. What so many do not reach stays inf, and a way that is found may not be the cheapest.

    Returns float32 at least. Raises ValueError or TypeError for shapes and dtypes that do not fit and, on a CPU, for
    costs that are not positive.
    """
    _check_grids(cost, goal)
    require_positive(resolution=resolution)
    if rounds is not None:
        require_count("rounds", rounds, "give 16, or None")
    look = readable(cost)
    limit = rounds or (cost.shape[1] * cost.shape[2] + 1 if look else ROUNDS)
    if look:
        hint = "give 1 for easy ground and inf for impassable"
        require(bool((cost > 0).all()), "cost", "must be positive", "NaN, or 0 and less", hint)
    with torch.no_grad():
        lines = _summable(cost.detach()).transpose(0, 1).contiguous()  # (H, B, W)
        ahead, across = (_steps(c, resolution) for c in (lines, lines.transpose(0, 2).contiguous()))
        free = goal.transpose(0, 1) & torch.isfinite(lines)
        value = torch.where(free, 0.0, torch.inf).to(lines.dtype)
        for _ in range(limit):
            before, value = value, value.clone()
            _sweep(value, ahead)
            turned = value.transpose(0, 2).contiguous()
            _sweep(turned, across)
            value = turned.transpose(0, 2).contiguous()
            if look and torch.equal(before, value):
                break
    return value.transpose(0, 1).contiguous()


def _summable(cost: Tensor) -> Tensor:
    """Return costs as float32 at least: half precision cannot add up a way."""
    return cost.to(torch.promote_types(cost.dtype, torch.float32))


def _check_grids(cost: object, goal: object) -> None:
    cost, goal = require_tensor("cost", cost), require_tensor("goal", goal)
    require(cost.dtype in FLOATS, "cost", "must be floats", cost.dtype, "convert it with .to(torch.float32)", TypeError)
    require(cost.ndim == 3, "cost", "expected (B, H, W)", tuple(cost.shape), "add the dimension of the maps")
    hint = "make it one with goal > 0"
    require(goal.dtype == torch.bool, "goal", "must be bool", goal.dtype, hint, TypeError)
    require(goal.shape == cost.shape, "goal", f"expected {tuple(cost.shape)}", tuple(goal.shape), "mark cells of cost")


def _way(a: Tensor, b: Tensor, length: float) -> Tensor:
    return (a + b) * (length / 2)


def _steps(lines: Float[Tensor, "L B N"], resolution: float) -> _Steps:
    here, there = lines[:-1], lines[1:]
    near, far = here[..., :-1] + there[..., 1:], here[..., 1:] + there[..., :-1]
    aslant = math.sqrt(2) * resolution
    cut = torch.isinf(near) | torch.isinf(far)
    rising, falling = (torch.where(cut, torch.inf, total * (aslant / 2)) for total in (near, far))
    return _Steps(_way(here, there, resolution), rising, falling)


def _sweep(value: Float[Tensor, "L B N"], steps: _Steps) -> None:
    """Carry the values from line to line to the last one and back, in place."""
    lines = list(zip(*(part.unbind(0) for part in (value, value[..., :-1], value[..., 1:])), strict=True))
    ways = list(zip(*(part.unbind(0) for part in steps), strict=True))
    for k, (straight, rising, falling) in enumerate(ways):
        _carry(lines[k], lines[k + 1], straight, rising, falling)
    for k in reversed(range(len(ways))):
        straight, rising, falling = ways[k]
        _carry(lines[k + 1], lines[k], straight, falling, rising)


def _carry(source: tuple[Tensor, ...], target: tuple[Tensor, ...], straight: Tensor, up: Tensor, down: Tensor) -> None:
    """Lower the values of a line, given whole, without its last and without its first cell, by way of another."""
    (all_s, first_s, last_s), (all_t, first_t, last_t) = source, target
    torch.minimum(all_t, all_s + straight, out=all_t)
    torch.minimum(last_t, first_s + up, out=last_t)
    torch.minimum(first_t, last_s + down, out=first_t)


# The way --------------------------------------------------------------------------------------------------------------


class Descent(NamedTuple):
    """The cells that a way passes."""

    cells: Int[Tensor, "B K 2"]  #: the last is repeated
    length: Float[Tensor, "B"]  #: [m]
    reached: Bool[Tensor, "B"]  #: it ends where the cost to go is 0


def descend(
    value: Float[Tensor, "B H W"],
    cost: Float[Tensor, "B H W"],
    start: Int[Tensor, "B 2"],
    *,
    resolution: float,
    max_cells: int,
) -> Descent:
    """Follow the cost to go from the cell `start` (i, j) of each map to the goal: each next cell is b of `cost_to_go`.

    Stays where no goal can be reached. Raises ValueError for shapes that do not fit and, on a CPU, cells outside.
    """
    require_count("max_cells", max_cells, "give 500")
    B, H, W = cost.shape
    fits = tuple(value.shape) == (B, H, W)
    require(fits, "value", f"expected {(B, H, W)}", tuple(value.shape), "give what cost_to_go returns")
    hint = "give one cell, i and j, for each map"
    require(tuple(start.shape) == (B, 2), "start", f"expected {(B, 2)}", tuple(start.shape), hint)
    for k, size in enumerate((H, W)):
        require_indices("start", start[:, k], size, "give cells of the map")
    cost = _summable(cost)
    onward = _next_cells(_summable(value), cost, resolution)
    cells = [start[:, :1] * W + start[:, 1:]]
    for _ in range(max_cells - 1):
        cells.append(onward.gather(1, cells[-1]))
    cell = torch.cat(cells, 1)
    way = torch.stack([torch.div(cell, W, rounding_mode="floor"), cell % W], -1)
    length = (way[:, 1:] - way[:, :-1]).to(cost.dtype).norm(dim=-1).sum(1) * resolution
    return Descent(way, length, value.flatten(1).gather(1, cells[-1])[:, 0] == 0)


def _next_cells(value: Tensor, cost: Tensor, resolution: float) -> Int[Tensor, "B H*W"]:
    """Return the number of the cell that comes next on the way from each; its own where the way ends."""
    B, H, W = cost.shape
    values, costs = neighbours(value, torch.inf), neighbours(cost, torch.inf)
    beside = dict(zip(AROUND, costs, strict=True))
    best, step = torch.full_like(value, torch.inf), torch.zeros(B, H, W, device=cost.device, dtype=torch.int64)
    for (i, j), v, c in zip(AROUND, values, costs, strict=True):
        total = v + _way(cost, c, math.hypot(i, j) * resolution)
        if i and j:
            total = torch.where(torch.isinf(beside[i, 0] + beside[0, j]), torch.inf, total)
        step = torch.where(total < best, i * W + j, step)
        best = torch.minimum(best, total)
    step = torch.where(value > 0, step, 0)
    return (step + torch.arange(H * W, device=cost.device).view(H, W)).flatten(1)
