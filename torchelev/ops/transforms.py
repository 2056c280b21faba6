"""Which of torch's differentiation modes and transforms run: what they forbid to read, to compute in C++, or to map."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchelev.errors import require


def is_transforming() -> bool:
    """Return whether a transform of `torch.func` runs: it wraps the tensors, whose values cannot be read then."""
    return not torch.compiler.is_compiling() and torch._C._functorch.peek_interpreter_stack() is not None


def require_reverse_mode(values: Iterable[object]) -> None:
    """Refuse inputs that `torch.func.vmap` batches, or that carry a tangent of forward-mode differentiation.

    Custom operators have no rule for either; torch would drop tangents without a word.
    """
    if torch.compiler.is_compiling() or not (is_transforming() or forward_ad._current_level >= 0):
        return
    tensors = [value for value in values if isinstance(value, Tensor)]
    hint = "use reverse mode: torch.func.grad, vjp or jacrev, or backward()"
    name, rule = "torch.func.jvp", "forward-mode differentiation (jvp, jacfwd) is not supported through the map"
    require(not _has_tangents(tensors), name, rule, "an input with a tangent", hint, NotImplementedError)
    name, rule = "torch.func.vmap", "is not supported through the map"
    hint = "the map is batched: give num_envs as many environments, and the inputs a first dimension of that size"
    batched = any(_is_batched(value) for value in tensors)
    require(not batched, name, rule, "an input that vmap batches", hint, NotImplementedError)


def _has_tangents(tensors: list[Tensor]) -> bool:
    stack = torch._C._functorch.get_interpreter_stack() or []
    if any(level.key() == torch._C._functorch.TransformType.Jvp for level in stack):
        return True
    return forward_ad._current_level >= 0 and any(forward_ad.unpack_dual(t).tangent is not None for t in tensors)


def _is_batched(value: Tensor) -> bool:
    functorch = torch._C._functorch
    while functorch.is_functorch_wrapped_tensor(value):
        if functorch.is_batchedtensor(value):
            return True
        value = functorch.get_unwrapped(value)
    return False


def is_readable(tensor: Tensor, may_wait: bool = False) -> bool:
    """Return whether the host may read a tensor now: it lies on the CPU, or the host `may_wait` for its device.

    Never true of fake tensors, and while torch compiles or transforms.
    """
    if torch.compiler.is_compiling() or torch._C._functorch.peek_interpreter_stack() is not None:
        return False
    return type(tensor) in (Tensor, torch.nn.Parameter) and (may_wait or tensor.is_cpu)


def can_compute_unseen(tensors: Iterable[Tensor]) -> bool:
    """Return whether C++ may compute with tensors on a CPU: torch needs to see no operation of it.

    It does to differentiate, to trace, and in a dispatch mode such as that of a FLOP counter.
    """
    if torch.compiler.is_compiling() or torch.jit.is_tracing() or torch._C._len_torch_dispatch_stack() > 0:
        return False
    records = torch.is_grad_enabled()
    is_plain = all(is_readable(tensor) and not (records and tensor.requires_grad) for tensor in tensors)
    return is_plain and forward_ad._current_level < 0
