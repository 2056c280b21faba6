"""Custom operators: what the compiler takes as it is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch


def custom_op(name: str, schema: str | None = None) -> Callable[[Callable], Callable[..., Any]]:
    """Make a function the operator `torchelev::<name>`, which changes no argument and returns new tensors alone.

    `torch.library.custom_op` checks the latter at every call, for half of what a call costs: 45 microseconds of an
    update. Here the tests check it, by `torch.library.opcheck`. Without a schema the annotations give it. Where no
    gradient is registered for it, it is to get detached tensors.
    """

    def register(function: Callable) -> Callable[..., Any]:
        qualified, signature = f"torchelev::{name}", schema or torch.library.infer_schema(function, mutates_args=())
        torch.library.define(qualified, signature, tags=(torch.Tag.pt2_compliant_tag,))
        torch.library.impl(qualified, "default", function)
        operator = getattr(torch.ops.torchelev, name).default
        operator.__wrapped__ = function
        return operator

    return register
