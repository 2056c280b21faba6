"""Harmonic heights in holes: conjugate gradients, preconditioned by a multigrid cycle, batched.

One equation per unknown cell: deg * u - (sum of u over its unknown neighbours) = sum of the known neighbours' heights,
of the four neighbours inside the map, deg how many there are. A coarse cell is a block of 2 x 2: its heights are one
number, so that its equation is of the same form again, with weights for what were 0 and 1.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.ops.operators import padded

DAMPING = 0.8  # of a Jacobi sweep
OVERCORRECTION = 1.8  # heights that are one number per block come out too low (Braess, Computing 55, 1995)
SAFETY = 4.0  # how much larger the error may be than a cycle's estimate of it


class Level(NamedTuple):
    """The equations of one grid, (B, H, W) each."""

    ahead: Tensor  #: weight of the edge to the next cell along H; 0 at the end
    beside: Tensor  #: weight of the edge to the next cell along W; 0 at the end
    sink: Tensor  #: weight of the edges to known cells
    share: Tensor  #: 1 / the sum of all of a cell's edges; 0 where there is no equation


def finish(ahead: Tensor, beside: Tensor, sink: Tensor) -> Level:
    """Add the diagonal to the weights."""
    total = sink + ahead + beside
    total[:, 1:] += ahead[:, :-1]
    total[:, :, 1:] += beside[:, :, :-1]
    return Level(ahead, beside, sink, (total > 0) / total.clamp(min=1e-6))


def finest(unknown: Tensor) -> Level:
    """Return the equations of the map, from a mask of 1 where unknown and 0 elsewhere."""
    ahead = F.pad(unknown[:, :-1] * unknown[:, 1:], (0, 0, 0, 1))
    beside = F.pad(unknown[:, :, :-1] * unknown[:, :, 1:], (0, 1))
    return finish(ahead, beside, unknown * four_sum(1 - unknown))


def four_sum(values: Tensor) -> Tensor:
    """Sum the four neighbours of each cell; nothing lies outside of the map."""
    rimmed = padded(values, 1, 0.0)
    rows = rimmed[:, :-2, 1:-1] + rimmed[:, 2:, 1:-1]
    return rows + (rimmed[:, 1:-1, :-2] + rimmed[:, 1:-1, 2:])


def block_sum(values: Tensor) -> Tensor:
    """Sum blocks of 2 x 2 cells; a side of odd length is continued with 0."""
    values = F.pad(values, (0, values.shape[2] % 2, 0, values.shape[1] % 2))
    rows = values[:, ::2] + values[:, 1::2]
    return rows[:, :, ::2] + rows[:, :, 1::2]


def coarser(level: Level) -> Level:
    """Return the equations of blocks of 2 x 2 cells: the weights of the edges between them, summed."""
    ahead, beside = torch.zeros_like(level.ahead), torch.zeros_like(level.beside)
    ahead[:, 1::2], beside[:, :, 1::2] = level.ahead[:, 1::2], level.beside[:, :, 1::2]
    return finish(block_sum(ahead), block_sum(beside), block_sum(level.sink))


def hierarchy(unknown: Tensor) -> list[Level]:
    """Return the equations of the map, of its blocks of 2 x 2 cells, and so on to a single cell."""
    levels = [finest(unknown)]
    while max(levels[-1].sink.shape[1:]) > 1:
        levels.append(coarser(levels[-1]))
    return levels


def residual(level: Level, u: Tensor, right: Tensor) -> Tensor:
    """Return right - A u."""
    left = torch.addcmul(right, level.sink, u, value=-1)
    flow = level.ahead[:, :-1] * (u[:, 1:] - u[:, :-1])
    left[:, :-1] += flow
    left[:, 1:] -= flow
    flow = level.beside[:, :, :-1] * (u[:, :, 1:] - u[:, :, :-1])
    left[:, :, :-1] += flow
    left[:, :, 1:] -= flow
    return left


def cycle(levels: list[Level], right: Tensor) -> Tensor:
    """Solve A u = right roughly: a Jacobi sweep, the coarser grids, another sweep. Linear, symmetric and definite."""
    level = levels[0]
    if len(levels) == 1:
        return level.share * right
    u = DAMPING * level.share * right
    correction = cycle(levels[1:], block_sum(residual(level, u, right)))
    H, W = right.shape[1:]
    spread = correction.repeat_interleave(2, 1).repeat_interleave(2, 2)[:, :H, :W]
    u = u + OVERCORRECTION * spread * (level.share > 0)
    return torch.addcmul(u, level.share, residual(level, u, right), value=DAMPING)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Sum the products of each map, (B, 1, 1)."""
    return (a * b).sum((1, 2), keepdim=True)


@torch.library.custom_op("torchelev::harmonic", mutates_args=())
def harmonic(unknown: Tensor, right: Tensor, tolerance: float, iterations: int) -> Tensor:
    """Solve A u = right for (B, H, W) by preconditioned conjugate gradients, until u is right to about `tolerance`.

    `unknown` is 1 where there is an equation, else 0, as u is. A map that is solved stands still while the others go
    on, `iterations` steps at most. A CPU stops with the last one; elsewhere the host never waits.
    """
    levels = hierarchy(unknown)
    left = right * unknown
    u, none = torch.zeros_like(left), torch.zeros_like(left)
    estimate = cycle(levels, left)
    direction, product = estimate, dot(left, estimate)
    for _ in range(iterations):
        error = SAFETY * estimate.abs().amax((1, 2), keepdim=True)
        unsolved = (error > tolerance) & (product > 0)
        if u.device.type == "cpu" and not unsolved.any():
            break
        image = -residual(levels[0], direction, none)
        step = unsolved * quotient(product, dot(direction, image))
        u = u + step * direction
        left = left - step * image
        estimate = cycle(levels, left)
        before, product = product, dot(left, estimate)
        direction = estimate + quotient(product, before) * direction
    return u


def quotient(a: Tensor, b: Tensor) -> Tensor:
    """Return a / b, and 0 where b is not positive."""
    positive = b > 0
    return torch.where(positive, a / torch.where(positive, b, 1.0), 0.0)


@harmonic.register_fake
def _(unknown: Tensor, right: Tensor, tolerance: float, iterations: int) -> Tensor:
    return torch.empty_like(right, memory_format=torch.contiguous_format)


def _backward(ctx, grad: Tensor) -> tuple[None, Tensor, None, None]:
    (unknown,) = ctx.saved_tensors
    # A is symmetric. Its right-hand side is no height: the largest number of each map stands for a metre.
    scale = grad.detach().abs().amax((1, 2), keepdim=True)
    scale = torch.where(scale > 0, scale, 1.0)
    return None, harmonic(unknown, grad / scale * unknown, ctx.tolerance, ctx.iterations) * scale, None, None


def _keep(ctx, inputs: tuple, output: Tensor) -> None:
    ctx.save_for_backward(inputs[0])
    ctx.tolerance, ctx.iterations = inputs[2:]


harmonic.register_autograd(_backward, setup_context=_keep)
