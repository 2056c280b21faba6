"""Laplace's equation in holes: conjugate gradients preconditioned by a multigrid cycle, for a batch of maps.

One equation per unknown cell: deg * u - (sum of u over unknown neighbours) = sum of the known neighbours' heights, over
the four neighbours inside the map, deg being their number. On coarser grids a cell is a block of 2 x 2 cells with a
single height, so that its equation has the same form, with other edge weights than 0 and 1.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.ops.library import LIBRARY, operator
from torchelev.ops.windows import padded

DAMPING = 0.8  # of a Jacobi sweep
OVERCORRECTION = 1.8  # heights that are constant per block come out too low (Braess, Computing 55, 1995)
SAFETY = 4.0  # ratio of the assumed error to a cycle's estimate of it


class _Level(NamedTuple):
    """The equations of one grid, (B, H, W) each."""

    ahead: Tensor  #: weight of the edge to the next cell along H; 0 at the end
    beside: Tensor  #: weight of the edge to the next cell along W; 0 at the end
    sink: Tensor  #: total weight of the edges to known cells
    inverse: Tensor  #: 1 / the total weight of the cell's edges; 0 where there is no equation


def _make_level(ahead: Tensor, beside: Tensor, sink: Tensor) -> _Level:
    """Complete the weights with the inverse of the diagonal."""
    total = sink + ahead + beside
    total[:, 1:] += ahead[:, :-1]
    total[:, :, 1:] += beside[:, :, :-1]
    return _Level(ahead, beside, sink, (total > 0) / total.clamp(min=1e-6))


def _finest(unknown: Tensor) -> _Level:
    """Return the equations of the map; `unknown` is 1 or 0."""
    ahead = F.pad(unknown[:, :-1] * unknown[:, 1:], (0, 0, 0, 1))
    beside = F.pad(unknown[:, :, :-1] * unknown[:, :, 1:], (0, 1))
    return _make_level(ahead, beside, unknown * four_sum(1 - unknown))


def four_sum(values: Tensor) -> Tensor:
    """Sum the four neighbours of each cell; outside the map is 0."""
    rimmed = padded(values, 1, 0.0)
    rows = rimmed[:, :-2, 1:-1] + rimmed[:, 2:, 1:-1]
    return rows + (rimmed[:, 1:-1, :-2] + rimmed[:, 1:-1, 2:])


def _block_sum(values: Tensor) -> Tensor:
    """Sum blocks of 2 x 2 cells; a side of odd length is padded with 0."""
    values = F.pad(values, (0, values.shape[2] % 2, 0, values.shape[1] % 2))
    rows = values[:, ::2] + values[:, 1::2]
    return rows[:, :, ::2] + rows[:, :, 1::2]


def _coarser(level: _Level) -> _Level:
    """Return the equations of blocks of 2 x 2 cells: edges between blocks add up."""
    ahead, beside = torch.zeros_like(level.ahead), torch.zeros_like(level.beside)
    ahead[:, 1::2], beside[:, :, 1::2] = level.ahead[:, 1::2], level.beside[:, :, 1::2]
    return _make_level(_block_sum(ahead), _block_sum(beside), _block_sum(level.sink))


def _hierarchy(unknown: Tensor) -> list[_Level]:
    """Return the equations of the map, of its blocks of 2 x 2 cells, and so on to a single cell."""
    levels = [_finest(unknown)]
    while max(levels[-1].sink.shape[1:]) > 1:
        levels.append(_coarser(levels[-1]))
    return levels


def _residual(level: _Level, u: Tensor, right: Tensor) -> Tensor:
    """Return right - A u."""
    rest = torch.addcmul(right, level.sink, u, value=-1)
    flow = level.ahead[:, :-1] * (u[:, 1:] - u[:, :-1])
    rest[:, :-1] += flow
    rest[:, 1:] -= flow
    flow = level.beside[:, :, :-1] * (u[:, :, 1:] - u[:, :, :-1])
    rest[:, :, :-1] += flow
    rest[:, :, 1:] -= flow
    return rest


def _cycle(levels: list[_Level], right: Tensor) -> Tensor:
    """Solve A u = right approximately: a Jacobi sweep, the coarser grids, another sweep.

    Linear in `right`, symmetric and positive definite, as a preconditioner must be.
    """
    level = levels[0]
    if len(levels) == 1:
        return level.inverse * right
    u = DAMPING * level.inverse * right
    correction = _cycle(levels[1:], _block_sum(_residual(level, u, right)))
    H, W = right.shape[1:]
    spread = correction.repeat_interleave(2, 1).repeat_interleave(2, 2)[:, :H, :W]
    u = u + OVERCORRECTION * spread * (level.inverse > 0)
    return torch.addcmul(u, level.inverse, _residual(level, u, right), value=DAMPING)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Return each map's inner product, (B, 1, 1)."""
    return (a * b).sum((1, 2), keepdim=True)


def _empty_heights(unknown: Tensor, right: Tensor, tolerance: float, iterations: int) -> Tensor:
    return torch.empty_like(right, memory_format=torch.contiguous_format)


@operator(
    "harmonic(Tensor unknown, Tensor right, float tolerance, int iterations) -> Tensor",
    fake=_empty_heights,
)
def solve_laplace(unknown: Tensor, right: Tensor, tolerance: float, iterations: int) -> Tensor:
    """Solve A u = right (B, H, W) by preconditioned conjugate gradients, to an error of about `tolerance`.

    `unknown` is 1 where there is an equation, else 0; there u is 0. Solved maps stay unchanged while others continue.
    A CPU stops once all are solved; other devices take all `iterations`, so that the host never waits.
    """
    levels = _hierarchy(unknown)
    rest = right * unknown
    u, none = torch.zeros_like(rest), torch.zeros_like(rest)
    estimate = _cycle(levels, rest)
    direction, product = estimate, _dot(rest, estimate)
    for _ in range(iterations):
        error = SAFETY * estimate.abs().amax((1, 2), keepdim=True)
        is_unsolved = (error > tolerance) & (product > 0)
        if u.device.type == "cpu" and not is_unsolved.any():
            break
        image = -_residual(levels[0], direction, none)
        step = is_unsolved * _quotient(product, _dot(direction, image))
        u = u + step * direction
        rest = rest - step * image
        estimate = _cycle(levels, rest)
        before, product = product, _dot(rest, estimate)
        direction = estimate + _quotient(product, before) * direction
    return u


def _quotient(a: Tensor, b: Tensor) -> Tensor:
    """Return a / b, and 0 where b is not positive."""
    is_positive = b > 0
    return torch.where(is_positive, a / torch.where(is_positive, b, 1.0), 0.0)


def _backward(ctx, grad: Tensor) -> tuple[None, Tensor, None, None]:
    (unknown,) = ctx.saved_tensors
    # A is symmetric. Gradients have no metres for the tolerance: scale the largest of each map to one.
    scale = grad.detach().abs().amax((1, 2), keepdim=True)
    scale = torch.where(scale > 0, scale, 1.0)
    return None, solve_laplace(unknown, grad / scale * unknown, ctx.tolerance, ctx.iterations) * scale, None, None


def _keep(ctx, inputs: tuple, output: Tensor) -> None:
    ctx.save_for_backward(inputs[0])
    ctx.tolerance, ctx.iterations = inputs[2:]


torch.library.register_autograd("torchelev::harmonic", _backward, setup_context=_keep, lib=LIBRARY)
