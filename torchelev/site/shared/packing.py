"""Windows as rows of bytes, one for each robot, to be sent to other processes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.site.fusion.windows import Contribution, Known, Windows, no_alignment, no_contribution

if TYPE_CHECKING:
    from jaxtyping import Bool, UInt8


class Layout(NamedTuple):
    """The layout of the rows, the same on all ranks.

    Cell numbers are int64, times, rates and offsets float64, layers float32 and masks bits: 20.5 bytes per cell and 32
    per robot; with earlier contributions, 32.625 bytes per cell and 88 per robot.
    """

    height: int  #: H, cells
    width: int  #: W, cells
    with_contribution: bool  #: whether any robot has contributed before

    @property
    def num_bytes(self) -> int:
        """Bytes of a robot."""
        return sum(_width(dtype, shape) for dtype, shape in self.parts())

    def parts(self) -> list[tuple[torch.dtype, tuple[int, ...]]]:
        """Return the type and the shape, per robot, of the parts of a row, in their order."""
        layer = (self.height, self.width)
        known = [(torch.int64, (2,)), *2 * [(torch.float64, ())], *3 * [(torch.float32, layer)], (torch.bool, layer)]
        surface = [*2 * [(torch.float32, layer)], *3 * [(torch.bool, layer)]]
        contribution = [*known, (torch.float64, ()), (torch.float64, (2,))]
        return [*known, *surface, *(contribution if self.with_contribution else [])]


def pack(windows: Windows, layout: Layout) -> UInt8[Tensor, "B n"]:
    """Return the rows of B robots."""
    values = _values(windows, layout.with_contribution)
    rows = [_to_bytes(value.to(dtype)) for value, (dtype, _) in zip(values, layout.parts(), strict=True)]
    return torch.cat(rows, 1)


def unpack(rows: UInt8[Tensor, "B n"], layout: Layout) -> Windows:
    """Return the parts of the packed windows that a merge reads."""
    parts = layout.parts()
    columns = rows.split([_width(dtype, shape) for dtype, shape in parts], 1)
    values = [_from_bytes(column, dtype, shape) for column, (dtype, shape) in zip(columns, parts, strict=True)]
    known, (gradient_x, gradient_y, has_normal, is_bounded, is_new) = _known(values[:7]), values[7:12]
    contribution = _unpack_contribution(values[12:]) if layout.with_contribution else None
    return Windows(known, gradient_x, gradient_y, has_normal, known.elevation, is_bounded, is_new, contribution)


def _values(windows: Windows, with_contribution: bool) -> list[Tensor]:
    """Return the contents of a row. A cell has a height or an upper bound, so that one layer holds both."""
    known = windows.known
    height = torch.where(windows.is_bounded, windows.upper_bound, known.elevation)
    surface = windows.gradient_x, windows.gradient_y, windows.has_normal, windows.is_bounded, windows.is_new
    values = [*_of_known(known._replace(elevation=height)), *surface]
    if with_contribution:
        contribution = windows.contribution or no_contribution(known, torch.zeros_like(known.corner[:, 0]))
        values += [*_of_known(contribution.known), contribution.alignment.offset, contribution.alignment.tilt]
    return values


def _of_known(known: Known) -> list[Tensor]:
    return [known.corner, known.now, known.rate, known.elevation, known.variance, known.age, known.is_known]


def _known(values: list[Tensor]) -> Known:
    corner, now, rate, elevation, variance, age, is_known = values
    return Known(corner, elevation, variance, age, is_known, now, rate)


def _unpack_contribution(values: list[Tensor]) -> Contribution:
    """Return a contribution without the clocks and resets of the maps, which only their own rank needs."""
    known, zero = _known(values[:7]), values[0].new_zeros(len(values[0]))
    alignment = no_alignment(len(zero), zero.device)._replace(offset=values[7], tilt=values[8])
    return Contribution(known, alignment, zero, zero, zero - 1)


def _width(dtype: torch.dtype, shape: tuple[int, ...]) -> int:
    number = math.prod(shape)
    return math.ceil(number / 8) if dtype == torch.bool else number * dtype.itemsize


def _to_bytes(values: Tensor) -> UInt8[Tensor, "B n"]:
    flat = values.reshape(len(values), -1).clone(memory_format=torch.contiguous_format)  # of one robot, strides too
    return _pack_bits(flat) if values.dtype == torch.bool else flat.view(torch.uint8)


def _from_bytes(column: UInt8[Tensor, "B n"], dtype: torch.dtype, shape: tuple[int, ...]) -> Tensor:
    flat = column.clone(memory_format=torch.contiguous_format)  # numbers must be aligned
    values = _unpack_bits(flat, math.prod(shape)) if dtype == torch.bool else flat.view(dtype)
    return values.view(len(column), *shape)


def _pack_bits(mask: Bool[Tensor, "B n"]) -> UInt8[Tensor, "B m"]:
    padded = torch.nn.functional.pad(mask.to(torch.uint8), (0, -mask.shape[1] % 8)).view(len(mask), -1, 8)
    return (padded << torch.arange(8, dtype=torch.uint8, device=mask.device)).sum(2, dtype=torch.uint8)


def _unpack_bits(packed: UInt8[Tensor, "B m"], number: int) -> Bool[Tensor, "B n"]:
    bits = (packed[:, :, None] >> torch.arange(8, dtype=torch.uint8, device=packed.device)) & 1
    return bits.flatten(1)[:, :number].bool().contiguous()
