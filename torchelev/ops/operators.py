"""Operations that the compiler makes 5 to 30 times slower on a CPU: as custom operators they stay as they are.

It would turn sums per cell into atomic additions, test at every read of a border whether it lies outside, and compute
every term of a running minimum again for every reader. On a GPU, where each operation costs a launch, the
compiler does borders and running minima, and CUDA kernels (`on_gpu`) do the polar tables.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.ops import native, on_gpu, scatter
from torchelev.ops.transforms import with_gradient


def _compiles_for_gpu(values: Tensor) -> bool:
    return torch.compiler.is_compiling() and not values.is_cpu and not torch.is_grad_enabled()


@torch.library.custom_op("torchelev::cell_sums", mutates_args=())
def _cell_sums(index: Tensor, values: Tensor, size: int) -> Tensor:
    """Sum values (K, B, M) by the slots `index` (B, M) in [0, size): -> (K, B, size). Slots never mix environments."""
    sums = native.cell_sums(index, values, size)
    return scatter.add(index, values, size) if sums is None else sums


@_cell_sums.register_fake
def _(index: Tensor, values: Tensor, size: int) -> Tensor:
    return values.new_empty(values.shape[0], values.shape[1], size)


def _cell_sums_backward(ctx, grad: Tensor) -> tuple[None, Tensor, None]:
    (index,) = ctx.saved_tensors
    return None, grad.gather(2, index.expand(grad.shape[0], *index.shape)), None


def _keep_index(ctx, inputs: tuple, output: Tensor) -> None:
    ctx.save_for_backward(inputs[0])


cell_sums = with_gradient(_cell_sums, _keep_index, _cell_sums_backward)


@torch.library.custom_op("torchelev::padded", mutates_args=())
def _padded(values: Tensor, radius: int, fill: float) -> Tensor:
    """Put a rim of `radius` cells around (..., H, W)."""
    return F.pad(values, [radius] * 4, value=fill)


@_padded.register_fake
def _(values: Tensor, radius: int, fill: float) -> Tensor:
    return values.new_empty(*values.shape[:-2], values.shape[-2] + 2 * radius, values.shape[-1] + 2 * radius)


def _padded_backward(ctx, grad: Tensor) -> tuple[Tensor, None, None]:
    r = ctx.radius
    return grad[..., r:-r, r:-r].contiguous(), None, None


def _keep_radius(ctx, inputs: tuple, output: Tensor) -> None:
    ctx.radius = inputs[1]


_padded_with_gradient = with_gradient(_padded, _keep_radius, _padded_backward)


def padded(values: Tensor, radius: int, fill: float) -> Tensor:
    """Put a rim of `radius` cells around (..., H, W)."""
    if _compiles_for_gpu(values):
        return F.pad(values, [radius] * 4, value=fill)
    return _padded_with_gradient(values, radius, fill)


def _scan_rows(rows: Sequence[Tensor]) -> None:
    """Turn each row into the minimum of itself and all before it, in place."""
    for before, row in itertools.pairwise(rows):
        torch.minimum(before, row, out=row)


def _scan(table: Tensor, from_end: bool) -> None:
    """Turn a table (B, R, P), R a multiple of 8, into its running minimum along R, in place.

    In blocks of eight rows, then over the blocks: each entry is touched twice, where doubling touches it log R times.
    """
    blocks = table.unflatten(1, (-1, 8))
    last = blocks[:, :, 0 if from_end else -1]
    steps, ends = blocks.unbind(2), last.unbind(1)
    _scan_rows(steps[::-1] if from_end else steps)
    _scan_rows(ends[::-1] if from_end else ends)
    inner, before = (blocks[:, :-1], last[:, 1:]) if from_end else (blocks[:, 1:], last[:, :-1])
    torch.minimum(inner, before.unsqueeze(2).clone(), out=inner)


@torch.library.custom_op("torchelev::running_minimum", mutates_args=())
def _running_minimum(table: Tensor) -> Tensor:
    result = native.running_minimum(table)
    if result is None:
        result = table.clone(memory_format=torch.contiguous_format)
        _scan(result, from_end=False)
    return result


@_running_minimum.register_fake
def _(table: Tensor) -> Tensor:
    return torch.empty_like(table, memory_format=torch.contiguous_format)


def running_minimum(table: Tensor) -> Tensor:
    """Return the running minimum along dimension 1, a multiple of 8: over j <= k."""
    return table.cummin(1).values if _compiles_for_gpu(table) else _running_minimum(table)


@torch.library.custom_op("torchelev::highest_per_cell", mutates_args=())
def highest_per_cell(index: Tensor, values: Tensor, size: int) -> Tensor:
    """Return the highest of the values (B, M) in each slot `index` (B, M): -> (B, size), -inf where there is none."""
    return scatter.highest(index, values, size, -torch.inf)


@highest_per_cell.register_fake
def _(index: Tensor, values: Tensor, size: int) -> Tensor:
    return values.new_empty(values.shape[0], size)


@torch.library.custom_op("torchelev::lowest_per_cell", mutates_args=())
def _lowest_per_cell(index: Tensor, values: Tensor, size: int, blank: float) -> Tensor:
    return scatter.lowest(index, values, size, blank)


@_lowest_per_cell.register_fake
def _(index: Tensor, values: Tensor, size: int, blank: float) -> Tensor:
    return values.new_empty(values.shape[0], size)


@torch.library.custom_op(
    "torchelev::polar_minimum",
    mutates_args=(),
    schema="(Tensor index, Tensor values, SymInt azimuths, SymInt[] widen, SymInt ranges, float blank) -> Tensor",
)
def _polar_minimum(index: Tensor, values: Tensor, azimuths: int, widen: list[int], ranges: int, blank: float) -> Tensor:
    rows = _table_rows(ranges)
    table = native.polar_minimum(index, values, rows, azimuths, widen, ranges, blank)
    if table is not None:
        return table
    if on_gpu.can_tabulate(values, widen):
        return on_gpu.polar_minimum(index, values, rows, azimuths, widen, ranges, blank)
    table = scatter.lowest(index, values, rows * azimuths, blank).unflatten(1, (rows, azimuths))
    table[:, ranges] = blank
    _scan(table, from_end=True)
    _widen(table, widen)
    return table


def _widen(table: Tensor, widen: list[int]) -> None:
    """Make each entry of the first widen[w] rows the minimum of itself and the entry 2^w on, level by level."""
    for half in table.chunk(2):  # of the environments, as each takes a copy, the largest of an update's values
        for level, rows in enumerate(widen):
            near = half[:, :rows]
            torch.minimum(near, near.roll(-(2**level), 2), out=near)


def _table_rows(ranges: int) -> int:
    return 8 * (ranges // 8 + 1)


@_polar_minimum.register_fake
def _(index: Tensor, values: Tensor, azimuths: int, widen: list[int], ranges: int, blank: float) -> Tensor:
    return values.new_empty(index.shape[0], _table_rows(ranges), azimuths)


def _keep_rays(ctx, inputs: tuple, output: Tensor) -> None:
    index, values, *ctx.sizes = inputs
    ctx.save_for_backward(index, values)


def _polar_minimum_backward(ctx, grad: Tensor) -> tuple[None, Tensor, None, None, None, None]:
    """Route the gradient of each entry to the ray whose value it holds; of equal ones to the first."""
    index, values = ctx.saved_tensors
    azimuths, widen, ranges, _ = ctx.sizes
    # The same table of the values' ranks, which are whole numbers that no two rays share, names that ray.
    order = values.argsort(dim=1, stable=True)
    number = values.shape[1]
    rank = torch.empty_like(values, dtype=torch.float64)
    rank = rank.scatter(1, order, torch.arange(number, device=values.device, dtype=torch.float64).expand(order.shape))
    lowest = _polar_minimum(index, rank, azimuths, widen, ranges, float(number)).flatten(1).to(torch.int64)
    by_rank = grad.new_zeros(grad.shape[0], number + 1).scatter_add(1, lowest, grad.reshape(lowest.shape))
    return None, by_rank[:, :number].gather(1, rank.to(torch.int64)), None, None, None, None


_polar_minimum_with_gradient = with_gradient(_polar_minimum, _keep_rays, _polar_minimum_backward)


def polar_minimum(index: Tensor, values: Tensor, azimuths: int, widen: list[int], ranges: int, blank: float) -> Tensor:
    """Return the table (B, R, azimuths) of the lowest value at or beyond each range and near each azimuth.

    `index` (B, N) is range * azimuths + azimuth of each value (B, N); range = `ranges` drops it. Every level w of
    `widen` makes an entry of the first widen[w] ranges the minimum of twice as many azimuths, itself the first of
    them. Row `ranges` and what follows it, R being a multiple of 8, are blank, for what lies out of reach.
    """
    if not _compiles_for_gpu(values) or on_gpu.can_tabulate(values, widen):
        return _polar_minimum_with_gradient(index, values, azimuths, widen, ranges, blank)
    size = _table_rows(ranges)
    table = _lowest_per_cell(index, values, size * azimuths, blank).unflatten(1, (size, azimuths))
    row = torch.arange(size, device=values.device)[:, None]
    table = torch.where(row == ranges, blank, table).flip(1).cummin(1).values.flip(1)
    for level, rows in enumerate(widen):
        table = torch.where(row < rows, torch.minimum(table, table.roll(-(2**level), 2)), table)
    return table
