"""What compiled code keeps in memory, and how. Uncompiled code stores every value anyway."""

from __future__ import annotations

import contextlib
import ctypes
import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

_TRIM_THRESHOLD = -1  # M_TRIM_THRESHOLD of glibc's malloc.h
_kept_sizes = [2**26]  # [bytes], in the order in which they were asked for
Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def stored(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Make compiled code store what a function returns: a tensor, or nested tuples of tensors.

    The compiler would otherwise compute a value anew for every reader: a sum over a window once per neighbour, a number
    of the environment once per point. Place it on functions whose result has several readers, or is gathered from.
    Masks are stored as bytes. What the function returns unchanged of its arguments is left as it is.
    """

    @functools.wraps(function)
    def run(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        result = function(*args, **kwargs)
        if not torch.compiler.is_compiling():
            return result
        given = _tensors(args)
        new = [value for value in _tensors(result) if not any(value is other for other in given)]
        return _replaced(result, new, realize_all(*new))

    return run


def _tensors(value: Any) -> list[Tensor]:
    """Return the tensors in nested tuples and lists."""
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, tuple | list):
        return [tensor for part in value for tensor in _tensors(part)]
    return []


def _replaced(value: Any, old: list[Tensor], new: list[Tensor]) -> Any:
    """Return nested tuples and lists with some tensors replaced."""
    if isinstance(value, Tensor):
        found = [other for one, other in zip(old, new, strict=True) if one is value]
        return found[0] if found else value
    if isinstance(value, tuple | list):
        parts = [_replaced(part, old, new) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    return value


@torch.library.custom_op("torchelev::realize", mutates_args=(), schema="(Tensor[] values) -> Tensor[]")
def _cloned(values: list[Tensor]) -> list[Tensor]:
    return [value.clone() for value in values]


@_cloned.register_fake
def _(values: list[Tensor]) -> list[Tensor]:
    return [torch.empty_like(value) for value in values]


_cloned.register_autograd(lambda ctx, grads: (grads,))


def realize(value: Tensor) -> Tensor:
    """Make compiled code store a value; see `stored`, which does so for the results of a function."""
    return realize_all(value)[0]


def realize_all(*values: Tensor) -> list[Tensor]:
    """Make compiled code store these values, masks as bytes.

    A demand for a memory layout does it at no cost but has no gradient; where one is wanted, the values are copied.
    """
    if not torch.compiler.is_compiling():
        return list(values)
    masks = [value.dtype == torch.bool for value in values]
    plain = [as_bytes(value) if mask else value for value, mask in zip(values, masks, strict=True)]
    kept = _cloned(plain) if torch.is_grad_enabled() else [_in_memory(value) for value in plain]
    return [as_mask(value) if mask else value for value, mask in zip(kept, masks, strict=True)]


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


def as_mask(bytes_: Tensor) -> Tensor:
    """Return the mask that `as_bytes` made bytes of. Compiled code compares integers eight times as fast as bytes."""
    # As a method, by which `mask_bytes.pass_bytes_on` tells masks from counts that are compared with 0.
    return bytes_.to(torch.int32).gt(0) if torch.compiler.is_compiling() else bytes_.view(torch.bool)


@functools.cache
def keep_freed_memory(size: int = 0) -> None:
    """Let glibc keep what updates on a CPU free: 64 MB, or `size` bytes if that is more. Does nothing elsewhere.

    It gives back what lies free above twice the largest block that it ever took from the system and saw freed, up to
    32 MB. With less than that an update faults its pages in anew each time: measured, 16 MB at 407,040 points and
    3.5 MB at 6,276, a quarter of the time. A block of nearly 32 MB, none of whose pages is touched, raises the limit.
    Beyond that the limit is set: a map of 200 x 200 m with cells of 10 cm else faults 75 MB in anew in some processes,
    which takes a quarter of the time.
    """
    torch.empty(2**25 - 2**16, dtype=torch.uint8, device="cpu")
    if size > max(_kept_sizes):
        _kept_sizes.append(size)
        with contextlib.suppress(AttributeError, OSError, TypeError):  # another allocator, or Windows
            ctypes.CDLL(None).mallopt(_TRIM_THRESHOLD, min(size, 2**31 - 1))
