"""The cost to go by value iteration, in sweeps over the rows and columns of maps: for any device, without waiting."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


class _StepCosts(NamedTuple):
    """Costs of the steps from each of L lines of N cells to the next one, on B maps; the same in both directions."""

    straight: Float[Tensor, "L-1 B N"]  # between (l, n) and (l + 1, n)
    rising: Float[Tensor, "L-1 B N-1"]  # between (l, n) and (l + 1, n + 1)
    falling: Float[Tensor, "L-1 B N-1"]  # between (l, n + 1) and (l + 1, n)


def iterate(
    cost: Float[Tensor, "B H W"],
    goal: Bool[Tensor, "B H W"],
    resolution: float,
    max_rounds: int,
    until_convergence: bool,
) -> Float[Tensor, "B H W"]:
    """Compute `cost_to_go` by rounds of sweeps.

    Args:
        cost: the cost of each metre in a cell.
        goal: the cells to reach.
        resolution: side of a cell [m].
        max_rounds: the largest number of rounds.
        until_convergence: whether to end after a round that changes nothing; the host waits for the device.
    """
    lines = cost.transpose(0, 1).contiguous()  # (H, B, W)
    row_steps, column_steps = (_step_costs(c, resolution) for c in (lines, lines.transpose(0, 2).contiguous()))
    is_target = goal.transpose(0, 1) & torch.isfinite(lines)
    value = torch.where(is_target, 0.0, torch.inf).to(lines.dtype)
    for _ in range(max_rounds):
        previous, value = value, value.clone()
        _sweep(value, row_steps)
        transposed = value.transpose(0, 2).contiguous()
        _sweep(transposed, column_steps)
        value = transposed.transpose(0, 2).contiguous()
        if until_convergence and torch.equal(previous, value):
            break
    return value.transpose(0, 1).contiguous()


def step_cost(a: Tensor, b: Tensor, length: float) -> Tensor:
    """Return the cost of steps of this length [m] between cells of costs a and b."""
    return (a + b) * (length / 2)


def _step_costs(lines: Float[Tensor, "L B N"], resolution: float) -> _StepCosts:
    here, there = lines[:-1], lines[1:]
    rising, falling = here[..., :-1] + there[..., 1:], here[..., 1:] + there[..., :-1]
    half_diagonal = math.sqrt(2) * resolution / 2
    cuts_corner = torch.isinf(rising) | torch.isinf(falling)
    rising, falling = (torch.where(cuts_corner, torch.inf, total * half_diagonal) for total in (rising, falling))
    return _StepCosts(step_cost(here, there, resolution), rising, falling)


def _sweep(value: Float[Tensor, "L B N"], costs: _StepCosts) -> None:
    """Propagate the values from line to line to the last one and back, in place."""
    lines = list(zip(*(part.unbind(0) for part in (value, value[..., :-1], value[..., 1:])), strict=True))
    steps = list(zip(*(part.unbind(0) for part in costs), strict=True))
    for k, (straight, rising, falling) in enumerate(steps):
        _relax(lines[k], lines[k + 1], straight, rising, falling)
    for k in reversed(range(len(steps))):
        straight, rising, falling = steps[k]
        _relax(lines[k + 1], lines[k], straight, falling, rising)


def _relax(source: tuple[Tensor, ...], target: tuple[Tensor, ...], straight: Tensor, up: Tensor, down: Tensor) -> None:
    """Lower a line's values to those of its neighbour plus a step; lines are (all, all but last, all but first)."""
    (source_all, source_low, source_high), (target_all, target_low, target_high) = source, target
    torch.minimum(target_all, source_all + straight, out=target_all)
    torch.minimum(target_high, source_low + up, out=target_high)
    torch.minimum(target_low, source_high + down, out=target_low)
