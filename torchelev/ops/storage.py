"""What the compiler is to store, and how; masks as bytes or bits. Eager code stores every value anyway."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Int, Shaped


@torch.library.custom_op("torchelev::realize", mutates_args=(), schema="(Tensor[] values) -> Tensor[]")
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
    """Demand a contiguous layout, which the compiler can only meet in memory."""
    from torch._inductor import inductor_prims  # takes a second to import, which only compiling needs

    strides = [1] * value.ndim
    for dim in range(value.ndim - 2, -1, -1):
        strides[dim] = strides[dim + 1] * value.shape[dim + 1]
    return inductor_prims.force_stride_order(value, strides)


def as_bytes(mask: Tensor) -> Tensor:
    """Return a mask as 0 and 1 in uint8. Compiled code stores bytes many times as fast as booleans on a CPU."""
    # By way of int32, whose vectors it makes of a mask, and bytes of them, in one step each.
    return mask.to(torch.int32).to(torch.uint8) if torch.compiler.is_compiling() else mask.view(torch.uint8)


def as_mask(stored: Tensor) -> Tensor:
    """Return what `as_bytes` stored. Compiled code compares integers eight times as fast as bytes."""
    return stored.to(torch.int32) > 0 if torch.compiler.is_compiling() else stored.view(torch.bool)


def read(values: Shaped[Tensor, "B K"], index: Int[Tensor, "B I J"]) -> Shaped[Tensor, "B I J"]:
    """Give each entry the value at its index."""
    if torch.compiler.is_compiling():  # a flat index it would store, or divide to find row and column
        environment = torch.arange(len(index), device=index.device, dtype=index.dtype)[:, None, None]
        return torch.ops.aten._unsafe_index(values, [environment, index])
    return values.gather(1, index.flatten(1).to(torch.int64)).view_as(index)


def as_bits(masks: list[Tensor]) -> Tensor:
    """Return up to eight masks as the bits of one uint8."""
    return functools.reduce(torch.add, (mask.to(torch.int32) << k for k, mask in enumerate(masks))).to(torch.uint8)


def from_bits(bits: Tensor, number: int) -> list[Tensor]:
    """Return the masks that `as_bits` packed."""
    return [(bits.to(torch.int32) & (1 << k)) > 0 for k in range(number)]


@functools.cache
def keep_freed_memory() -> None:
    """Let glibc keep up to 64 MB that a CPU's updates free. Does nothing to other allocators.

    It gives back what lies free above twice the largest block that it ever took from the system and saw freed, up to
    32 MB. With less than that an update faults its pages in anew each time: measured, 16 MB at 407,040 points and
    3.5 MB at 6,276, a quarter of the time. A block of nearly 32 MB, none of whose pages is touched, raises the limit.
    """
    torch.empty(2**25 - 2**16, dtype=torch.uint8, device="cpu")
