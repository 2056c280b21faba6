"""Which of torch's differentiation modes and `torch.func` transforms run, and which of them the map refuses."""

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


def is_readable(values: Tensor) -> bool:
    """Return whether the host may read the values without waiting: on a CPU, outside of transforms and compilers."""
    return values.is_cpu and type(values) is Tensor and not is_transforming() and not torch.compiler.is_compiling()
