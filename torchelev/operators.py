"""The few operations that the compiler makes slower: sums per cell, sums over windows, running minima.

It would turn the first into atomic additions and fuse the others' shifted reads into kernels that compute every term
again for every reader, 10 to 30 times slower on a CPU. As custom operators they stay plain in eager and compiled code.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


@torch.library.custom_op("torchelev::realize", mutates_args=())
def _realize(values: list[Tensor]) -> list[Tensor]:
    return [value.clone() for value in values]


@_realize.register_fake
def _(values: list[Tensor]) -> list[Tensor]:
    return [torch.empty_like(value) for value in values]


_realize.register_autograd(lambda ctx, grads: (grads,))


def realize(value: Tensor) -> Tensor:
    """Return a copy. The compiler would otherwise compute the values anew wherever they are read."""
    return realize_all(value)[0]


def realize_all(*values: Tensor) -> list[Tensor]:
    """Return copies; one call for many, because each call costs the host some 30 microseconds.

    Eager code computes each value once anyway, and keeps it.
    """
    return _realize(list(values)) if torch.compiler.is_compiling() else list(values)


@torch.library.custom_op("torchelev::cell_sums", mutates_args=())
def cell_sums(index: Tensor, values: Tensor, size: int) -> Tensor:
    """Sum values (K, B, M) by the slots `index` (B, M) in [0, size): -> (K, B, size). Slots never mix environments."""
    # One row per column and environment: rows run in parallel, and each stays in the cache.
    zeros = values.new_zeros(values.shape[0], values.shape[1], size)
    return zeros.scatter_add_(2, index.expand(values.shape), values)


@cell_sums.register_fake
def _(index: Tensor, values: Tensor, size: int) -> Tensor:
    return values.new_empty(values.shape[0], values.shape[1], size)


def _cell_sums_backward(ctx, grad: Tensor) -> tuple[None, Tensor, None]:
    (index,) = ctx.saved_tensors
    return None, grad.gather(2, index.expand(grad.shape[0], *index.shape)), None


def _keep_index(ctx, inputs: tuple, output: Tensor) -> None:
    ctx.save_for_backward(inputs[0])


cell_sums.register_autograd(_cell_sums_backward, setup_context=_keep_index)


def moment_orders(order: int) -> list[tuple[int, int]]:
    """List the exponents (a, b) of u^a v^b with a + b <= order <= 2, in the order of `window_moments`."""
    return [(a, b) for a in range(order + 1) for b in range(order + 1 - a)]


def _line_moments(values: Tensor, radius: int, orders: int, dim: int) -> list[Tensor]:
    """Sum u^a * values for a = 0..orders along one dimension that is padded by `radius`."""
    size = values.shape[dim] - 2 * radius
    center = values.narrow(dim, radius, size)
    sums = [center.clone(), torch.zeros_like(center), torch.zeros_like(center)][: orders + 1]
    for k in range(1, radius + 1):
        after, before = values.narrow(dim, radius + k, size), values.narrow(dim, radius - k, size)
        pair = after + before
        sums[0] += pair
        if orders >= 1:
            sums[1].add_(after, alpha=k).sub_(before, alpha=k)
        if orders >= 2:
            sums[2].add_(pair, alpha=k * k)
    return sums


@torch.library.custom_op("torchelev::window_moments", mutates_args=())
def window_moments(values: Tensor, radius: int, order: int) -> Tensor:
    """Sum u^a v^b * values over the (2 * radius + 1)^2 window around each cell, zeros outside the layer.

    u and v count cells from the window's centre along H and W. (B, H, W) -> (K, B, H, W), K as in `moment_orders`.
    """
    padded = F.pad(values, [radius] * 4)
    along_x = _line_moments(padded, radius, order, -2)
    return torch.stack([s for a in range(order + 1) for s in _line_moments(along_x[a], radius, order - a, -1)])


@window_moments.register_fake
def _(values: Tensor, radius: int, order: int) -> Tensor:
    return values.new_empty(len(moment_orders(order)), *values.shape)


def _moments_backward(ctx, grad: Tensor) -> tuple[Tensor, None, None]:
    # The operator is linear; its transpose has the same kernels, mirrored: (-1)^(a + b).
    total = torch.zeros_like(grad[0])
    for k, (a, b) in enumerate(moment_orders(ctx.order)):
        moments = window_moments(grad[k].contiguous(), ctx.radius, a + b)
        total = total + (-1) ** (a + b) * moments[moment_orders(a + b).index((a, b))]
    return total, None, None


def _keep_settings(ctx, inputs: tuple, output: Tensor) -> None:
    _, ctx.radius, ctx.order = inputs


window_moments.register_autograd(_moments_backward, setup_context=_keep_settings)


@torch.library.custom_op("torchelev::running_minimum", mutates_args=())
def running_minimum(table: Tensor, from_end: bool) -> Tensor:
    """Return the running minimum along dimension 1 by doubling: over j <= k, or over j >= k from the end."""
    table, other, step, size = table.clone(), torch.empty_like(table), 1, table.shape[1]
    while step < size:
        kept, reduced = (slice(-step, None), slice(-step)) if from_end else (slice(step), slice(step, None))
        torch.minimum(table[:, :-step], table[:, step:], out=other[:, reduced])
        other[:, kept] = table[:, kept]
        table, other, step = other, table, 2 * step
    return table


@running_minimum.register_fake
def _(table: Tensor, from_end: bool) -> Tensor:
    return torch.empty_like(table)


@torch.library.custom_op("torchelev::azimuth_pyramid", mutates_args=())
def azimuth_pyramid(table: Tensor, levels: int) -> Tensor:
    """Append to the last dimension its minima over 2, 4, ... 2^levels neighbours."""
    stack = [table]
    for _ in range(levels):
        stack.append(torch.minimum(stack[-1][..., ::2], stack[-1][..., 1::2]))
    return torch.cat(stack, -1)


@azimuth_pyramid.register_fake
def _(table: Tensor, levels: int) -> Tensor:
    return table.new_empty(*table.shape[:-1], sum(table.shape[-1] >> k for k in range(levels + 1)))
