"""The few operations that the compiler makes slower: sums per cell, borders, running minima.

It would turn the first into atomic additions, test at every read whether it lies outside, and compute every term of a
running minimum again for every reader, 5 to 30 times slower on a CPU. As custom operators they stay plain in eager and
compiled code.
"""

from __future__ import annotations

import itertools

import torch
import torch.nn.functional as F
from torch import Tensor
from torch._inductor import inductor_prims


@torch.library.custom_op("torchelev::realize", mutates_args=())
def _realize(values: list[Tensor]) -> list[Tensor]:
    return [value.clone() for value in values]


@_realize.register_fake
def _(values: list[Tensor]) -> list[Tensor]:
    return [torch.empty_like(value) for value in values]


_realize.register_autograd(lambda ctx, grads: (grads,))


def realize(value: Tensor) -> Tensor:
    """Make the compiler store the values. It would otherwise compute them anew wherever they are read."""
    return realize_all(value)[0]


def realize_all(*values: Tensor) -> list[Tensor]:
    """Make the compiler store these values, masks as bytes; eager code does so anyway.

    A demand for a memory layout does it at no cost but has no gradient; where one is wanted, the values are copied.
    """
    if not torch.compiler.is_compiling():
        return list(values)
    masks = [value.dtype == torch.bool for value in values]
    plain = [as_bytes(value) if mask else value for value, mask in zip(values, masks, strict=True)]
    stored = _realize(plain) if torch.is_grad_enabled() else [_in_memory(value) for value in plain]
    return [as_mask(value) if mask else value for value, mask in zip(stored, masks, strict=True)]


def _in_memory(value: Tensor) -> Tensor:
    strides = [1]
    for size in reversed(value.shape[1:]):
        strides.insert(0, strides[0] * size)
    return inductor_prims.force_stride_order(value, strides[-value.ndim :])


def as_bytes(mask: Tensor) -> Tensor:
    """Return a mask as 0 and 1 in uint8. Compiled code stores bytes eight times as fast as booleans on a CPU."""
    return torch.where(mask, 1, 0).to(torch.uint8) if torch.compiler.is_compiling() else mask.view(torch.uint8)


def as_mask(stored: Tensor) -> Tensor:
    """Return what `as_bytes` stored. Compiled code compares integers eight times as fast as bytes."""
    return stored.to(torch.int32) > 0 if torch.compiler.is_compiling() else stored.view(torch.bool)


@torch.library.custom_op("torchelev::moved", mutates_args=())
def moved(layers: list[Tensor], shift: Tensor, blanks: list[float]) -> list[Tensor]:
    """Shift layers (B, H, W) by whole cells (B, 2), environment by environment; entering cells are blank."""
    results = [torch.full_like(layer, blank) for layer, blank in zip(layers, blanks, strict=True)]
    H, W = layers[0].shape[1:]
    for env, (i, j) in enumerate(shift.tolist()):
        if abs(i) < H and abs(j) < W:
            to = (env, slice(max(0, -i), H - max(0, i)), slice(max(0, -j), W - max(0, j)))
            source = (env, slice(max(0, i), H - max(0, -i)), slice(max(0, j), W - max(0, -j)))
            for result, layer in zip(results, layers, strict=True):
                result[to].copy_(layer[source])
    return results


@moved.register_fake
def _(layers: list[Tensor], shift: Tensor, blanks: list[float]) -> list[Tensor]:
    return [torch.empty_like(layer) for layer in layers]


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


@torch.library.custom_op("torchelev::padded", mutates_args=())
def padded(values: Tensor, radius: int, fill: float) -> Tensor:
    """Put a rim of `radius` cells around (..., H, W)."""
    return F.pad(values, [radius] * 4, value=fill)


@padded.register_fake
def _(values: Tensor, radius: int, fill: float) -> Tensor:
    return values.new_empty(*values.shape[:-2], values.shape[-2] + 2 * radius, values.shape[-1] + 2 * radius)


def _padded_backward(ctx, grad: Tensor) -> tuple[Tensor, None, None]:
    r = ctx.radius
    return grad[..., r:-r, r:-r].contiguous(), None, None


def _keep_radius(ctx, inputs: tuple, output: Tensor) -> None:
    ctx.radius = inputs[1]


padded.register_autograd(_padded_backward, setup_context=_keep_radius)


def _scan_rows(rows: list[Tensor]) -> None:
    """Turn each row into the minimum of itself and all before it, in place."""
    for before, row in itertools.pairwise(rows):
        torch.minimum(before, row, out=row)


def _scan(table: Tensor, from_end: bool) -> None:
    """Turn a table (B, R, P), R a multiple of 8, into its running minimum along R, in place.

    In blocks of eight rows, then over the blocks: each entry is touched twice, where doubling touches it log R times.
    """
    blocks = table.unflatten(1, (-1, 8))
    steps = [blocks[:, :, k] for k in range(8)]
    last = blocks[:, :, 0 if from_end else -1]
    ends = [last[:, k] for k in range(blocks.shape[1])]
    _scan_rows(steps[::-1] if from_end else steps)
    _scan_rows(ends[::-1] if from_end else ends)
    inner, before = (blocks[:, :-1], last[:, 1:]) if from_end else (blocks[:, 1:], last[:, :-1])
    torch.minimum(inner, before.unsqueeze(2).clone(), out=inner)


@torch.library.custom_op("torchelev::running_minimum", mutates_args=())
def running_minimum(table: Tensor, from_end: bool) -> Tensor:
    """Return the running minimum along dimension 1, a multiple of 8: over j <= k, or over j >= k from the end."""
    table = table.clone()
    _scan(table, from_end)
    return table


@running_minimum.register_fake
def _(table: Tensor, from_end: bool) -> Tensor:
    return torch.empty_like(table)


@torch.library.custom_op("torchelev::polar_minimum", mutates_args=())
def polar_minimum(index: Tensor, values: Tensor, azimuths: int, widen: list[int], ranges: int, blank: float) -> Tensor:
    """Return the table (B, R, azimuths) of the lowest value at or beyond each range and near each azimuth.

    `index` (B, N) is range * azimuths + azimuth of each value (B, N); range = `ranges` drops it. Every level w of
    `widen` makes an entry of the first widen[w] ranges the minimum of twice as many azimuths, itself the first of
    them. Row `ranges` and what follows it, R being a multiple of 8, are blank, for what lies out of reach.
    """
    rows = _table_rows(ranges)
    table = values.new_full((index.shape[0], rows * azimuths), blank)
    table.scatter_reduce_(1, index, values, "amin")
    table = table.unflatten(1, (rows, azimuths))
    table[:, ranges] = blank
    _scan(table, from_end=True)
    for level, rows in enumerate(widen):
        near = table[:, :rows]
        torch.minimum(near, near.roll(-(2**level), 2), out=near)
    return table


def _table_rows(ranges: int) -> int:
    return 8 * (ranges // 8 + 1)


@polar_minimum.register_fake
def _(index: Tensor, values: Tensor, azimuths: int, widen: list[int], ranges: int, blank: float) -> Tensor:
    return values.new_empty(index.shape[0], _table_rows(ranges), azimuths)
