"""The compiled update: how it is compiled, announced, kept and found again."""

from __future__ import annotations

import contextlib
import functools
import itertools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from types import FunctionType
from typing import Any

import torch
from torch import Tensor

from torchelev.config import ElevationMapConfig
from torchelev.pipeline import update, update_in_place, write
from torchelev.state import MapState
from torchelev.storage import as_bytes, as_mask
from torchelev.traversability_net import Weights

KERNEL_ARGUMENTS = 16  # measured: 12 to 24 do as well


def inductor(graph: torch.fx.GraphModule, inputs: list[Any]) -> Callable[..., Any]:
    """Compile by torch's compiler, with what pays off here, as far as this torch knows it."""
    from torch._inductor import compile, config  # takes a second to import, which only compiling needs

    # Other names, as its cache does not see `short_kernels` and else would give what it made without.
    options: dict[str, Any] = {"cpp.descriptive_names": "inductor_node"}
    if hasattr(config.cpp, "enable_tiling_heuristics"):
        # The compiler gives up vectorisation on many gathers, which pays off in the loops over points.
        options["cpp.enable_tiling_heuristics"] = False
    with short_kernels():
        return compile(graph, inputs, options)


@contextlib.contextmanager
def short_kernels() -> Iterator[None]:
    """Let the compiler end a C++ function after so many arguments; it has no option for this.

    A function holds all that it stores until its end. One of all the loops between two operators takes 32 MB in place
    of 13 with the learned head, and half a millisecond more, as that is more than the caches hold.
    """
    from torch._inductor.codegen.cpp import CppScheduling

    name = "MAX_FUSED_KERNEL_ARGS_NUM"
    usual = getattr(CppScheduling, name, None)
    setattr(CppScheduling, name, KERNEL_ARGUMENTS)
    try:
        yield
    finally:
        setattr(CppScheduling, name, usual)


_number = itertools.count()


def own_code(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with a code object of its own.

    The compiler finds its graphs by code object and guards. Functions that differ by what they enclose alone, which no
    guard looks at here, would be given each other's graphs; and of one code object it keeps no more than eight.
    """
    assert isinstance(function, FunctionType)
    code = function.__code__.replace(co_name=f"{function.__name__}_{next(_number)}")
    return FunctionType(code, function.__globals__, code.co_name, function.__defaults__, function.__closure__)


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function as one compiled graph; call what it returns under `announced_compilation`."""
    options: dict[str, Any] = {}
    if hasattr(torch.compiler, "skip_guard_on_globals_unsafe"):
        options["guard_filter_fn"] = guards_on_arguments
    return torch.compile(own_code(function), fullgraph=True, backend=inductor, options=options)


def guards_on_arguments(guards: Sequence[Any]) -> list[bool]:
    """Choose which guards are checked before each call: not those on code and config, which are frozen.

    Checking these hundreds took a third of a millisecond.
    """
    return [not guard.is_global and "cfg" not in guard.name and "__dict__" not in guard.name for guard in guards]


@contextlib.contextmanager
def announced_compilation() -> Iterator[None]:
    """Say on stderr what is going on for a minute, and what it cost, if anything is compiled."""
    from torch._dynamo.callback import callback_handler

    starts: list[float] = []

    def announce(*_: Any) -> None:
        if not starts:
            print("torchelev: compiling the update, for up to a minute ...", end=" ", file=sys.stderr, flush=True)
        starts.append(time.perf_counter())

    callback_handler.register_start_callback(announce)
    end = "failed"
    try:
        yield
        if starts:
            end = f"done in {time.perf_counter() - starts[0]:.0f} s. Later processes find it in the compiler's cache."
    finally:
        if announce in callback_handler.start_callbacks:  # a reset of the compiler clears them
            callback_handler.remove_start_callback(announce)
        if starts:
            print(end, file=sys.stderr, flush=True)


def compiled_update(
    stored: MapState, points: Tensor, *others: Any, cfg: ElevationMapConfig, weights: Weights | None = None
) -> None:
    """Do what `update_in_place` does, compiled, for any number of points."""
    if points.shape[2] < 2:  # the compiler treats sizes 0 and 1 as constants
        update_in_place(stored, points, *others, cfg=cfg, weights=weights)
        return
    inputs = [None if value is None else packed(value) for value in (points, *others)]
    for values in (inputs[0], inputs[-1]):
        if values is not None:
            torch._dynamo.maybe_mark_dynamic(values, 2)
    kinds = tuple(None if value is None else (value.dtype, value.device) for value in inputs)
    with announced_compilation():
        graph_of(cfg, kinds, points.shape[1])(with_masks(stored, as_bytes), *inputs, weights=weights)


@functools.cache
def graph_of(cfg: ElevationMapConfig, kinds: tuple, sensors: int) -> Callable[..., None]:
    """Return what compiles and keeps the updates of one kind of inputs, for any number of environments."""

    def in_place(stored: MapState, *others: Any, weights: Weights | None) -> None:
        """Update; masks come as bytes, see `as_bytes`. Writing within the graph saves a copy of every layer."""
        write(stored, with_masks(update(with_masks(stored, as_mask), *others, cfg=cfg, weights=weights), as_bytes))

    return compiled(in_place)


def packed(value: Tensor) -> Tensor:
    """Return the values with the strides of a new tensor; a slice or an expansion would get other graphs."""
    return value.reshape(-1).view(value.shape)


def with_masks(state: MapState, convert: Callable[[Tensor], Tensor]) -> MapState:
    """Return the state with its masks converted."""
    return state._replace(validity=convert(state.validity), bounded=convert(state.bounded))
