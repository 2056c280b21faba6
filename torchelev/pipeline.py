"""The paper's overview figure: the stages in their order."""

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

from torchelev.aging import age
from torchelev.config import ElevationMapConfig
from torchelev.drift import compensate
from torchelev.fusion import fuse
from torchelev.grid import recenter
from torchelev.overlap import clear_other_floors
from torchelev.raycast import clear_seen_through
from torchelev.sensor import measure
from torchelev.state import MapState, Measurement, count, map_layers, tally
from torchelev.storage import as_bytes, as_mask
from torchelev.surface import known_ground, normals
from torchelev.traversability import TraversabilityConfig, learned_rating, rate_all, traversability
from torchelev.traversability_net import Weights


def fuse_measurement(
    state: MapState, m: Measurement, cfg: ElevationMapConfig, weights: Weights | None = None
) -> MapState:
    """Run the stages in order (paper, Fig. 2). Pure: it changes none of its arguments. `weights` are the head's."""
    grid = cfg.grid
    state = start_tally(state, m)
    state = recenter(state, m, grid)
    state = age(state, m, cfg.aging)
    if cfg.drift is not None:
        state = compensate(state, m, grid, cfg.drift, (cfg.traversability or TraversabilityConfig).drift_gate)
    state = fuse(state, m, grid, cfg.fusion)
    if cfg.raycast is not None:
        state = clear_seen_through(state, m, grid, cfg.raycast)
    if cfg.overlap is not None:
        state = clear_other_floors(state, m, grid, cfg.overlap)
    state = rate_surface(state, cfg, weights)
    return tally(state, cells_bounded=count(state.bounded & ~state.validity))


def rate_surface(state: MapState, cfg: ElevationMapConfig, weights: Weights | None = None) -> MapState:
    """Compute normals and traversability from the elevation."""
    head = cfg.traversability
    rim = max(cfg.surface.radius, head.cells(cfg.grid) if isinstance(head, TraversabilityConfig) else 0)
    ground = known_ground(state.elevation, state.validity, rim)
    state = normals(state, ground, cfg.grid, cfg.surface)
    if head is None:
        return rate_all(state)
    if isinstance(head, TraversabilityConfig):
        return traversability(state, ground, cfg.grid, head)
    assert weights is not None
    return state._replace(traversability=learned_rating(state, cfg.grid, head, weights).traversability)


def start_tally(state: MapState, m: Measurement) -> MapState:
    """Set the statistics to zero, and to what the sensor's gates rejected."""
    gates = ("rejected_invalid", "rejected_range", "rejected_body", "rejected_overhang")
    zeros = {name: torch.zeros_like(value) for name, value in state.statistics._asdict().items()}
    return tally(state, **(zeros | {name: getattr(m, name) for name in gates}))


def update(
    state: MapState,
    points: Tensor,
    T_map_sensor: Tensor,
    T_map_base: Tensor | None,
    dt: Tensor,
    variance: Tensor | None,
    *,
    cfg: ElevationMapConfig,
    weights: Weights | None = None,
) -> MapState:
    """Measure and fuse; points come as (B, S, N, 3)."""
    m = measure(points, T_map_sensor, T_map_base, dt, variance, cfg.grid, cfg.sensor, state.elevation.dtype)
    return fuse_measurement(state, m, cfg, weights)


def update_in_place(stored: MapState, *inputs: Any, cfg: ElevationMapConfig, weights: Weights | None = None) -> None:
    """Measure, fuse, and write the new values into the stored state's own tensors."""
    write(stored, update(stored, *inputs, cfg=cfg, weights=weights))


def write(stored: MapState, new: MapState) -> None:
    """Copy the new values into the stored state's own tensors."""
    map_layers(Tensor.copy_, stored, new)


def with_masks(state: MapState, convert: Callable[[Tensor], Tensor]) -> MapState:
    """Return the state with its masks converted."""
    return state._replace(validity=convert(state.validity), bounded=convert(state.bounded))


def compiler_options() -> dict[str, Any]:
    """Return options of torch.compile that pay off here, as far as this torch knows them."""
    from torch._inductor import config  # takes a second to import, which only compiling needs

    options: dict[str, Any] = {}
    if hasattr(config.cpp, "enable_tiling_heuristics"):
        # The compiler gives up vectorisation on many gathers, which pays off in the loops over points.
        options["cpp.enable_tiling_heuristics"] = False
    if hasattr(torch.compiler, "skip_guard_on_globals_unsafe"):
        options["guard_filter_fn"] = guards_on_arguments
    return options


def guards_on_arguments(guards: Sequence[Any]) -> list[bool]:
    """Choose which guards are checked before each call: not those on code and config, which are frozen.

    Checking these hundreds took a third of a millisecond.
    """
    return [not guard.is_global and "cfg" not in guard.name and "__dict__" not in guard.name for guard in guards]


@contextlib.contextmanager
def announced_compilation() -> Iterator[None]:
    """Say on stderr what is going on for a minute, and what it cost."""
    print("torchelev: compiling the update, for up to a minute ...", end=" ", file=sys.stderr, flush=True)
    start, end = time.perf_counter(), "failed"
    try:
        yield
        end = f"done in {time.perf_counter() - start:.0f} s. Later processes find it in the compiler's cache."
    finally:
        print(end, file=sys.stderr, flush=True)


_number = itertools.count()


def own_code(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with a code object of its own.

    The compiler finds its graphs by code object and guards. Functions that differ by what they enclose alone, which no
    guard looks at here, would be given each other's graphs; and of one code object it keeps no more than eight.
    """
    assert isinstance(function, FunctionType)
    code = function.__code__.replace(co_name=f"{function.__name__}_{next(_number)}")
    return FunctionType(code, function.__globals__, code.co_name, function.__defaults__, function.__closure__)


def compiled_update(
    stored: MapState, points: Tensor, *others: Any, cfg: ElevationMapConfig, weights: Weights | None = None
) -> None:
    """Do what `update_in_place` does, compiled: any number of points, and of environments from the second on."""
    if points.shape[2] < 2:  # the compiler treats sizes 0 and 1 as constants
        update_in_place(stored, points, *others, cfg=cfg, weights=weights)
        return
    inputs = [None if value is None else packed(value) for value in (points, *others)]
    for values in (inputs[0], inputs[-1]):
        if values is not None:
            torch._dynamo.maybe_mark_dynamic(values, 2)
    kinds = tuple(None if value is None else (value.dtype, value.device) for value in inputs)
    graph, known_sizes = graphs_of(cfg, kinds, points.shape[1])
    with contextlib.nullcontext() if points.shape[0] in known_sizes else announced_compilation():
        graph(with_masks(stored, as_bytes), *inputs, weights=weights)
    known_sizes.add(points.shape[0])


@functools.cache
def graphs_of(cfg: ElevationMapConfig, kinds: tuple, sensors: int) -> tuple[Callable[..., None], set[int]]:
    """Return what compiles and keeps the updates of one kind of inputs, and a set for the sizes of batch it knows."""

    def in_place(stored: MapState, *others: Any, weights: Weights | None) -> None:
        """Update; masks come as bytes, see `as_bytes`. Writing within the graph saves a copy of every layer."""
        write(stored, with_masks(update(with_masks(stored, as_mask), *others, cfg=cfg, weights=weights), as_bytes))

    return torch.compile(own_code(in_place), fullgraph=True, options=compiler_options()), set()


def packed(value: Tensor) -> Tensor:
    """Return the values with the strides of a new tensor; a slice or an expansion would get other graphs."""
    return value.reshape(-1).view(value.shape)
