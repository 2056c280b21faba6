"""Rays over cells in one pass of C++ (`torchelev/native/rays`): the same as `apply_rays`, several times as fast."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

from torch import Tensor

from torchelev.grid import GridConfig, grid_of
from torchelev.native.library import load
from torchelev.ops.define import operator
from torchelev.ops.masks import NOWHERE, count
from torchelev.ops.native import run
from torchelev.stages.fast_layers import layers_of, layers_to_change, named, new_numbers, put
from torchelev.stages.visibility.config import RaycastConfig
from torchelev.stages.visibility.lowest_rays import NO_RAY, RayBins, View
from torchelev.stages.visibility.polar_table import PolarGrid
from torchelev.state import MapState, partial_state

CHANGED = ("validity", "bounded", "upper_bound", "challenger_support")
READ = ("elevation", "variance", "time", "gradient_x", "gradient_y", "challenger")  # in the order of C++, like CHANGED
_CONSTANTS = {"NO_RAY": f"{NO_RAY!r}f", "NOWHERE": f"{NOWHERE!r}f"}
_LARGEST = 2**30  # entries of a table, as they are counted in 32 bits

Apply = Callable[[MapState, RayBins, View, PolarGrid, GridConfig, RaycastConfig], MapState]


def in_one_pass(twin: Apply) -> Callable[..., tuple[MapState, Tensor]]:
    """Return a function that does what its twin does, and calls it where C++ cannot be built.

    It also returns how many cells were cleared (B,): compiled code would see `validity` as it is after the change.
    """

    @operator(
        "apply_rays(Tensor[] rays, Tensor[] view, Tensor[] layers, Tensor(a!)[] changed, int ranges, int azimuths, "
        "float bins, int[] widen, float[] settings) -> Tensor",
        lambda rays, *_: new_numbers(rays[0]),
    )
    def apply_to_layers(
        rays: list[Tensor],
        view: list[Tensor],
        layers: list[Tensor],
        changed: list[Tensor],
        ranges: int,
        azimuths: int,
        bins: float,
        widen: list[int],
        settings: list[float],
    ) -> Tensor:
        polar = PolarGrid(ranges, azimuths, bins, tuple(widen))
        number = _native(rays, view, layers, changed, polar, settings)
        if number is None:
            state, grid, cfg = _described(layers, changed, *settings)
            after = twin(state, RayBins(*rays), View(*view), polar, grid, cfg)
            number = count(state.validity & ~after.validity)
            put(changed, CHANGED, after)
        return number

    def apply(
        state: MapState,
        rays: RayBins,
        view: View,
        polar: PolarGrid,
        grid: GridConfig,
        cfg: RaycastConfig,
        into: MapState | None = None,
    ) -> tuple[MapState, Tensor]:
        sizes = polar.ranges, polar.azimuths, polar.bins, list(polar.widen)
        settings = [grid.resolution, cfg.min_time, cfg.min_incidence, cfg.gate]
        changed = layers_to_change(state, CHANGED, into)
        number = apply_to_layers(list(rays), list(view), layers_of(state, READ), changed, *sizes, settings)
        return state._replace(**named(CHANGED, changed)), number  # type: ignore[arg-type]

    return apply


def _described(
    layers: list[Tensor], changed: list[Tensor], resolution: float, min_time: float, min_incidence: float, gate: float
) -> tuple[MapState, GridConfig, RaycastConfig]:
    """Return what the operator was called for, as far as its twin asks."""
    cfg = RaycastConfig(min_time=min_time, min_incidence=min_incidence, gate=gate)
    return partial_state(**named((*READ, *CHANGED), [*layers, *changed])), grid_of(layers[0].shape[1:], resolution), cfg


def _native(
    rays: list[Tensor],
    view: list[Tensor],
    layers: list[Tensor],
    changed: list[Tensor],
    polar: PolarGrid,
    settings: list[float],
) -> Tensor | None:
    """Change layers, and return how many cells were cleared (B,); None where C++ cannot."""
    if layers[0].numel() == 0 or polar.ranges * polar.azimuths > _LARGEST:
        return None
    library = load("rays/rays.cpp", _CONSTANTS)
    if library is None:
        return None
    number = new_numbers(rays[0])
    sizes = (*rays[0].shape, *layers[0].shape[1:], polar.ranges, polar.azimuths, len(polar.widen))
    widen = (ctypes.c_int64 * len(polar.widen))(*polar.widen)
    read, numbers = [*rays, *view, *layers], map(float, settings)
    run(library.apply_rays, read, [*changed, number], *sizes, widen, polar.bins, *numbers)
    return number
