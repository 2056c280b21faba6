"""What ranks send to each other in a merge: tensors as bytes, written in place, and read without copying."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import UInt8

Shape = tuple[torch.dtype, tuple[int, ...]]

_DTYPES = (torch.int64, torch.int32, torch.float32)
_DIMENSIONS, _ALIGNED = 4, 8
_ROW = (1 + _DIMENSIONS) * _ALIGNED


def make_messages(
    shapes: Sequence[Sequence[Shape]], device: torch.device
) -> tuple[UInt8[Tensor, "n"], list[int], list[list[Tensor]]]:
    """Return memory for messages one after another, the lengths of these, and their tensors, which are to be written.

    Args:
        shapes: types and shapes of the tensors of each message, of up to four dimensions; none: an empty message.
        device: of the memory.
    """
    lengths = [_ALIGNED + sum(_ROW + _length(shape) for shape in each) if each else 0 for each in shapes]
    memory, tensors = torch.empty(sum(lengths), dtype=torch.uint8, device=device), []
    for each, message in zip(shapes, memory.split(lengths), strict=True):
        if each:
            header = [len(each)]
            for dtype, shape in each:
                header += [_DTYPES.index(dtype), *shape, *[-1] * (_DIMENSIONS - len(shape))]
            message[: _ALIGNED * len(header)].view(torch.int64).copy_(torch.tensor(header))
        tensors.append(list(_views(message, each)))
    return memory, lengths, tensors


def read_message(message: UInt8[Tensor, "n"]) -> list[Tensor]:
    """Return the tensors of a message, which share its memory; none of an empty one."""
    if not len(message):
        return []
    number = int(message[:_ALIGNED].view(torch.int64))
    rows = message[_ALIGNED : _ALIGNED + number * _ROW].view(torch.int64).view(number, -1).tolist()
    return list(_views(message, [(_DTYPES[kind], tuple(n for n in shape if n >= 0)) for kind, *shape in rows]))


def _length(shape: Shape) -> int:
    """Return the bytes of a tensor, whole numbers of eight."""
    length = math.prod(shape[1]) * shape[0].itemsize
    return length + -length % _ALIGNED


def _views(message: UInt8[Tensor, "n"], shapes: Sequence[Shape]) -> Iterator[Tensor]:
    start = _ALIGNED + len(shapes) * _ROW
    for dtype, shape in shapes:
        length = math.prod(shape) * dtype.itemsize
        yield message[start : start + length].view(dtype).view(shape)
        start += _length((dtype, shape))
