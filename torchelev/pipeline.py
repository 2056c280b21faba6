"""The paper's overview figure: the stages in their order, for every backend."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import torch

from torchelev.config import ElevationMapConfig
from torchelev.inputs.update_inputs import Inputs
from torchelev.kernels import cpu_update
from torchelev.kernels.cpu_update import CpuUpdate, as_inputs
from torchelev.kernels.cuda_update import CudaUpdate
from torchelev.levels.compiled import KERNEL as LEVELS
from torchelev.levels.compiled import StoredLevels
from torchelev.stages.age.kernel import KERNEL as AGE
from torchelev.stages.age.stage import age
from torchelev.stages.by_tensors import ByTensors
from torchelev.stages.compensate.kernel import KERNEL as COMPENSATE
from torchelev.stages.compensate.stage import compensate
from torchelev.stages.disagreement.kernel import KERNEL as DISAGREEMENT
from torchelev.stages.disagreement.stage import add_disagreement, subtract_disagreement, without_disagreement
from torchelev.stages.fusion.kernel import KERNEL as FUSION
from torchelev.stages.fusion.stage import fuse
from torchelev.stages.measure.kernel import KERNEL as MEASURE
from torchelev.stages.measure.stage import find_own, measure
from torchelev.stages.overlap.kernel import KERNEL as OVERLAP
from torchelev.stages.overlap.stage import clear_other_floors
from torchelev.stages.recenter.kernel import KERNEL as RECENTER
from torchelev.stages.recenter.stage import recenter
from torchelev.stages.surface.kernel import KERNEL as SURFACE
from torchelev.stages.surface.stage import rate_surface
from torchelev.stages.visibility.kernel import KERNEL as VISIBILITY
from torchelev.stages.visibility.stage import clear_seen_through, count_bounded
from torchelev.state import CARRIED, MapState, Measurement, Statistics, map_layers, tally
from torchelev.traversability.heads import LearnedTraversabilityConfig, learned_rating

if TYPE_CHECKING:
    from torchelev.traversability.weight_file import Weights

#: Of all stages, in no order.
KERNELS = (MEASURE, RECENTER, AGE, COMPENSATE, DISAGREEMENT, FUSION, VISIBILITY, OVERLAP, SURFACE, LEVELS)
TENSORS: tuple[Any, ...] = (
    ("Statistics", Statistics, {}),
    ("MapState", MapState, {"statistics": "Statistics"}),
    ("StoredLevels", StoredLevels, {}),
)


class Stage(NamedTuple):
    """One stage: its definition by tensors. `run_<name>` in its folder's cpu.cpp computes the same, in place."""

    name: str  #: of the stage, on every backend
    run: Callable[[MapState, Measurement, ElevationMapConfig], MapState]  #: returns the state after it


#: What an update does after `measure`: the only statement of the order. The learned head follows, see `rate_learned`.
STAGES = (
    Stage("reset_statistics", lambda state, m, cfg: reset_statistics(state, m)),
    Stage("subtract_disagreement", lambda state, m, cfg: subtract_disagreement(state)),
    Stage("recenter", lambda state, m, cfg: recenter(state, m, cfg.grid)),
    Stage("age", lambda state, m, cfg: age(state, m, cfg.aging, cfg.fusion.max_variance)),
    Stage(
        "compensate",
        lambda state, m, cfg: compensate(state, m, cfg.grid, cfg.drift, cfg.drift_gate, cfg.fusion.max_variance),
    ),
    Stage("fuse", lambda state, m, cfg: fuse(state, m, cfg.grid, cfg.fusion, has_rays=cfg.raycast is not None)),
    Stage("clear_seen_through", lambda state, m, cfg: clear_seen_through(state, m, cfg.grid, cfg.raycast)),
    Stage(
        "clear_other_floors",  # levels choose the floor, and keep the others
        lambda state, m, cfg: clear_other_floors(state, m, cfg.grid, None if cfg.has_levels else cfg.overlap),
    ),
    Stage("count_bounded", lambda state, m, cfg: count_bounded(state)),
    Stage("add_disagreement", lambda state, m, cfg: add_disagreement(state)),
    Stage("rate_surface", lambda state, m, cfg: rate_surface(state, cfg.grid, cfg.surface, cfg.traversability)),
)

#: The names of all steps of an update, as the compiled backends run them.
ORDER = ("measure", *(stage.name for stage in STAGES))

#: What maps with levels do instead of a step: their points leave the scan before any other step reads it, and they rise
#: with the ground. By tensors, `functional.forward` of levels has the order.
_WITH_LEVELS = {
    "measure": ("measure", "recenter", "sort_levels"),
    "recenter": (),
    "compensate": ("compensate", "raise_levels"),
}
ORDER_WITH_LEVELS = tuple(step for name in ORDER for step in _WITH_LEVELS.get(name, (name,)))


def forward(state: MapState, m: Measurement, cfg: ElevationMapConfig, weights: Weights | None = None) -> MapState:
    """Run the stages in their order (paper, Fig. 2). Pure: changes none of its arguments. `weights` are the head's."""
    for stage in STAGES:
        state = stage.run(state, m, cfg)
    return rate_learned(state, cfg, weights)


def rate_learned(state: MapState, cfg: ElevationMapConfig, weights: Weights | None) -> MapState:
    """Rate known cells by the learned head, if that is configured; by tensors on every backend."""
    head = cfg.traversability
    if not isinstance(head, LearnedTraversabilityConfig):
        return state
    assert weights is not None
    relative = state._replace(variance=without_disagreement(state))
    rating = learned_rating(relative, cfg.grid, head, weights)
    return state._replace(traversability=rating.traversability, rated=state.validity)


def rate(state: MapState, cfg: ElevationMapConfig, weights: Weights | None = None) -> MapState:
    """Compute normals and traversability from the elevation."""
    state = rate_surface(state, cfg.grid, cfg.surface, cfg.traversability)
    return rate_learned(state, cfg, weights)


def reset_statistics(state: MapState, m: Measurement) -> MapState:
    """Set the statistics to zero, and to what the sensor's gates rejected; keep those that the next update reads."""
    gates = ("rejected_invalid", "rejected_range", "rejected_body", "rejected_overhang")
    zeros = {n: torch.zeros_like(value) for n, value in state.statistics._asdict().items() if n not in CARRIED}
    return tally(state, **(zeros | {name: getattr(m, name) for name in gates}))


# Backends -----------------------------------------------------------------------------------------------------------


def update_by_tensors(stored: MapState, inputs: Inputs, cfg: ElevationMapConfig, weights: Weights | None) -> None:
    """Measure, fuse, and write the new values into the stored state's own tensors."""
    m = measure(*inputs, cfg.grid, cfg.sensor, stored.elevation.dtype)
    write(stored, forward(stored, m, cfg, weights))


def update_in_place(
    stored: MapState,
    inputs: Inputs,
    levels: StoredLevels | None = None,
    *,
    cfg: ElevationMapConfig,
    weights: Weights | None,
    key: int,
) -> None:
    """Do the same in place: by one call of C++ on a CPU, that of levels too, by kernels on a GPU.

    `key` is that of `register_stages`.
    """
    tensors = (*stored[:-1], *stored.statistics)
    values = as_inputs(inputs._asdict() | {"own": find_own(inputs, cfg.sensor)})
    if stored.elevation.is_cuda:
        with torch.cuda.device_of(stored.elevation):
            cuda_stages(cfg).run(tensors, values)
    else:
        cpu_update.run(key, tensors, values, levels or ())
    if isinstance(cfg.traversability, LearnedTraversabilityConfig):
        write(stored, rate_learned(stored, cfg, weights))


@functools.lru_cache(maxsize=64)
def cuda_stages(cfg: ElevationMapConfig) -> CudaUpdate:
    """Return the CUDA kernels for a config; they are built when they first run."""
    return CudaUpdate(KERNELS, TENSORS, ORDER, cfg, ElevationMapConfig())


def only_by_tensors(cfg: ElevationMapConfig) -> str:
    """Return in a clause why no compiled code runs the stages of a config; empty where it does."""
    for group in ("sensor", "drift", "fusion", "raycast", "overlap", "surface"):
        for name, value in vars(getattr(cfg, group) or object).items():
            if isinstance(value, ByTensors):
                return f"no compiled code computes {group}.{name}"
    return ""


@functools.lru_cache(maxsize=256)
def register_stages(cfg: ElevationMapConfig) -> int:
    """Return the key of the C++ stages for a config; they are built when they first run. -1 if only tensors run it."""
    if only_by_tensors(cfg):
        return -1
    order = ORDER_WITH_LEVELS if cfg.has_levels else ORDER
    return cpu_update.register(CpuUpdate(KERNELS, TENSORS, order, cfg, ElevationMapConfig()))


def write(stored: MapState, new: MapState) -> None:
    """Copy the new values into the stored state's own tensors."""
    map_layers(lambda old, value: old if value is old else old.copy_(value), stored, new)
