"""Functions as operators of torch's dispatcher, which `torch.compile` and `torch.func` keep whole.

As `torch.library.custom_op` makes them, whose first call imports the compiler: some 800 modules, in seconds.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import torch

LIBRARY = torch.library.Library("torchelev", "FRAGMENT")
F = TypeVar("F", bound=Callable[..., Any])


def operator(schema: str, fake: Callable[..., Any]) -> Callable[[F], F]:
    """Make a function the operator `torch.ops.torchelev.<name>`, on every device; it has no gradient of its own.

    Args:
        schema: name, arguments and results as torch writes them: "negate(Tensor x) -> Tensor".
        fake: takes the same arguments and returns tensors of the result's shape, dtype and device, of any values.

    Returns:
        A decorator. The function itself is `__wrapped__` of what it returns.
    """
    name = schema.partition("(")[0]

    def register(function: F) -> F:
        LIBRARY.define(schema)
        LIBRARY.impl(name, torch.no_grad()(function), "CompositeExplicitAutograd")
        torch.library.register_fake(f"torchelev::{name}", fake, lib=LIBRARY)
        registered = getattr(torch.ops.torchelev, name).default

        @functools.wraps(function)
        def call(*args: Any) -> Any:
            return registered(*args)

        return cast(F, call)

    return register
