"""Operators that have no gradient, with less work around each call than `torch.library.custom_op` does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

_LIBRARY = torch.library.Library("torchelev", "FRAGMENT")


def operator(schema: str, fake: Callable[..., Tensor | Sequence[Tensor] | None]) -> Callable[..., Any]:
    """Register a function as an operator, which returns new tensors or writes into its arguments.

    It has no gradient: call it without grad mode.

    Args:
        schema: name, arguments and results, such as "half(Tensor values) -> Tensor".
        fake: returns tensors of the right shapes and dtypes, see `torch.library.register_fake`.
    """
    name = schema.partition("(")[0]

    def define(function: Callable[..., Any]) -> Callable[..., Any]:
        _LIBRARY.define(schema)
        _LIBRARY.impl(name, function, "CompositeExplicitAutograd")
        torch.library.register_fake(f"torchelev::{name}", fake, lib=_LIBRARY)
        defined: Callable[..., Any] = getattr(torch.ops.torchelev, name).default
        return defined

    return define
