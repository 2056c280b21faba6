"""The update as three compiled graphs."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from torchelev.compiled.compiler import announced_compilation, packed
from torchelev.compiled.elsewhere import run_elsewhere
from torchelev.compiled.kept_graphs import Dynamic, KeptGraph, surroundings
from torchelev.config import ElevationMapConfig
from torchelev.errors import require
from torchelev.ops.moving import gains_by_moving_in_place
from torchelev.ops.storage import as_bytes, as_mask
from torchelev.pipeline import count_bounded, rate_surface, reset_statistics, update_in_place
from torchelev.stages.age.stage import age
from torchelev.stages.compensate.stage import compensate
from torchelev.stages.fast_layers import has_one_pass
from torchelev.stages.fusion.native import can_update_in_cpp
from torchelev.stages.fusion.stage import fuse
from torchelev.stages.measure.stage import measure
from torchelev.stages.overlap.stage import clear_other_floors
from torchelev.stages.recenter.stage import recenter
from torchelev.stages.visibility.stage import clear_seen_through
from torchelev.state import LAYERS, MASKS, MapState, Measurement, blank_state, map_layers
from torchelev.traversability.weight_file import Weights


def compiled_update(
    stored: MapState, points: Tensor, *others: Any, cfg: ElevationMapConfig, weights: Weights | None = None
) -> None:
    """Do what `update_in_place` does, compiled, for any number of points."""
    if points.shape[2] < 2:  # the compiler treats sizes 0 and 1 as constants
        update_in_place(stored, points, *others, cfg=cfg, weights=weights)
        return
    strided = [name for name in LAYERS if not getattr(stored, name).is_contiguous()]
    hint = "load the map by `load_state`, or copy the layers"
    require(not strided, "state", "must hold contiguous layers", ", ".join(strided), hint)
    with torch.inference_mode(False), torch.no_grad():
        inputs = [None if value is None else packed(value) for value in (points, *others)]
    kinds = tuple(None if value is None else (value.dtype, value.device) for value in inputs)
    with announced_compilation():
        graphs = graphs_of(cfg, kinds, points.shape[1])
        stored = with_masks(stored, as_bytes)
        if graphs.move_window.is_missing(stored, *inputs):
            compile_side_by_side(len(stored.elevation), stored.elevation.dtype, inputs, cfg, weights)
        m = graphs.move_window(stored, *inputs)
        graphs.fuse_heights(stored, m)
        graphs.apply_rays(stored, m, weights)


def compile_ahead(
    inputs: Sequence[Tensor | None], sizes: Iterable[int], dtype: torch.dtype, cfg: ElevationMapConfig, weights: Any
) -> None:
    """Run compiled updates for each number of environments, of the first ones of these inputs, on a blank state."""
    sizes = list(sizes)
    points = inputs[0]
    assert points is not None
    with torch.inference_mode(False), torch.no_grad():
        scratch = blank_state(cfg.grid, max(sizes), points.device, dtype)
    with torch.inference_mode():
        for size in sizes:
            state = map_layers(lambda layer, n=size: layer[:n], scratch)
            first: list[Any] = [None if value is None else value[:size] for value in inputs]
            compiled_update(state, *first, cfg=cfg, weights=weights)


def compile_side_by_side(
    num_envs: int,
    dtype: torch.dtype,
    inputs: Sequence[Tensor | None],
    cfg: ElevationMapConfig,
    weights: Weights | None,
) -> None:
    """Let other processes compile some of the graphs, the longest first, while this one compiles the others.

    Whoever comes first to a graph compiles it, and the other waits for it.
    """
    processes = min(len(os.sched_getaffinity(0)), len(Graphs._fields)) if hasattr(os, "sched_getaffinity") else 1
    shapes = [None if value is None else value.to("meta") for value in inputs]
    order = num_envs, dtype, shapes, cfg, weights, torch.get_num_threads(), surroundings()
    for part in ("apply_rays", "fuse_heights")[: processes - 1]:
        run_elsewhere(compile_part, part, *order)


def compile_part(
    part: str,
    num_envs: int,
    dtype: torch.dtype,
    shapes: Sequence[Tensor | None],
    cfg: ElevationMapConfig,
    weights: Weights | None,
    num_threads: int,
    wanted: str,
) -> None:
    """Compile one graph of an update into its file, for inputs of these shapes and dtypes, if `surroundings` agree."""
    torch.set_num_threads(num_threads)
    inputs: list[Any] = [None if value is None else torch.zeros_like(value, device="cpu") for value in shapes]
    kinds = tuple(None if value is None else (value.dtype, value.device) for value in inputs)
    graph: KeptGraph = getattr(graphs_of(cfg, kinds, inputs[0].shape[1]), part)
    with torch.inference_mode(False), torch.no_grad():
        blank = blank_state(cfg.grid, num_envs, inputs[0].device, dtype)
    with torch.inference_mode():
        if surroundings() != wanted:  # the other process has set modes that this one does not know
            return
        m = with_masks(measure(*inputs, cfg.grid, cfg.sensor, dtype), as_bytes)  # type: ignore[call-arg]
        graph.prepare(with_masks(blank, as_bytes), m, *([weights] if part == "apply_rays" else []))


# `pipeline.forward` in three parts, see `Graphs`.


def let_time_pass(state: MapState, m: Measurement, cfg: ElevationMapConfig) -> MapState:
    """Start an update of a window that has moved: forget the last one's statistics, and age the cells.

    C++ fuses heights where they are stored: there, the drift is compensated before.
    """
    state = age(reset_statistics(state, m), m, cfg.aging)
    return compensate(state, m, cfg.grid, cfg.drift, cfg.drift_gate) if can_update_in_cpp(state) else state


def fuse_heights(state: MapState, m: Measurement, cfg: ElevationMapConfig, into: MapState) -> MapState:
    """Compensate the height drift, and fuse the points' heights; `into`: the stored state, see `fuse`."""
    if not can_update_in_cpp(state):
        state = compensate(state, m, cfg.grid, cfg.drift, cfg.drift_gate)
    return fuse(state, m, cfg.grid, cfg.fusion, cfg.raycast is not None, into)


def apply_rays(
    state: MapState, m: Measurement, cfg: ElevationMapConfig, into: MapState, weights: Weights | None = None
) -> MapState:
    """Clear what is gone or another floor, and rate what is left; `into`: the stored state, in which C++ changes it."""
    stored = into if has_one_pass(state) else None
    left = clear_seen_through(state, m, cfg.grid, cfg.raycast, stored)
    left = clear_other_floors(left, m, cfg.grid, cfg.overlap, stored)
    left = rate_surface(count_bounded(left), cfg, weights, into)
    return left if stored is None else left._replace(validity=state.validity, bounded=state.bounded)


class Graphs(NamedTuple):
    """The parts of an update, compiled: what one stores on its way is free again before the next.

    Each writes what it changes into the stored state, which saves a copy of every layer; what stops a later one leaves
    an update without its points or rays, though on a CPU its drift is compensated. Masks come and go as bytes, see
    `as_bytes`.
    """

    move_window: KeptGraph  #: measures, moves the window and ages it; on a CPU compensates drift
    fuse_heights: KeptGraph  #: compensates drift, unless that is done, and fuses the points' heights
    apply_rays: KeptGraph  #: clears cells, bounds unknown ones and rates the rest


@functools.cache
def graphs_of(cfg: ElevationMapConfig, kinds: tuple, sensors: int) -> Graphs:
    """Return what compiles and keeps the updates of one kind of inputs, for any number of environments."""

    def first(stored: MapState, points: Tensor, *others: Any) -> Measurement:
        m = measure(points, *others, cfg.grid, cfg.sensor, stored.elevation.dtype)  # type: ignore[call-arg]
        in_place = gains_by_moving_in_place(stored.elevation)
        moved = recenter(stored, m, cfg.grid, in_place=True) if in_place else stored
        old = with_masks(stored, as_mask)
        if in_place:
            state = old._replace(corner=moved.corner, base_height=moved.base_height)
        else:
            state = recenter(old, m, cfg.grid)
        write_changes(stored, old, let_time_pass(state, m, cfg))
        return with_masks(m, as_bytes)

    def in_place(stages: Callable[..., MapState]) -> KeptGraph:
        def run(stored: MapState, m: Measurement, *weights: Weights | None) -> None:
            state = with_masks(stored, as_mask)
            write_changes(stored, state, stages(state, with_masks(m, as_mask), cfg, stored, *weights))

        return KeptGraph(run, (stages.__name__, *settings), measured)

    def measured(_: MapState, m: Measurement, *__: Weights | None) -> Dynamic:
        return Dynamic(1, (m.points, m.variance, m.used, m.casts, m.noise), multiple=sensors)

    settings = (cfg, kinds, sensors)
    move = KeptGraph(first, ("move_window", *settings), _sized_by_points)
    return Graphs(move, in_place(fuse_heights), in_place(apply_rays))


def _sized_by_points(_: MapState, points: Tensor, *others: Any) -> Dynamic:
    return Dynamic(2, (points, others[3]))  # and their variance


def write_changes(stored: MapState, old: MapState, new: MapState) -> None:
    """Write what is new into the stored state's own tensors, masks as bytes."""

    def write(stored: Tensor, old: Tensor, new: Tensor) -> Tensor:
        return stored if new is old else stored.copy_(as_bytes(new) if new.dtype == torch.bool else new)

    map_layers(write, stored, old, new)


Values = TypeVar("Values", MapState, Measurement)


def with_masks(values: Values, convert: Callable[[Tensor], Tensor]) -> Values:
    """Return a state or a measurement with its masks converted."""
    masks = {name: convert(getattr(values, name)) for name in (*MASKS, "used", "casts") if name in values._fields}
    return type(values)(**(values._asdict() | masks))  # what `_replace` makes, torch 2.11 cannot return from a graph
