"""The update of all cells in C++ (`torchelev/native/fusion`), for float32 without a gradient."""

from __future__ import annotations

import ctypes
import functools
from dataclasses import fields
from typing import Any

from torch import Tensor

from torchelev.grid import GridConfig, grid_of
from torchelev.native.library import load
from torchelev.ops.define import operator
from torchelev.ops.indexing import can_select
from torchelev.ops.native import run
from torchelev.ops.storage import as_bytes, as_mask
from torchelev.stages.cells import PointCells
from torchelev.stages.fast_layers import has_one_pass, named
from torchelev.stages.fusion.challenge import MIN_CHALLENGERS
from torchelev.stages.fusion.config import EdgeConfig, FusionConfig
from torchelev.stages.fusion.points import CellLayers, HitPoints
from torchelev.stages.fusion.update import Update, update_all
from torchelev.state import MapState

ARGUMENTS = (  # of the operators in C++ and on a GPU, which write into the last layers
    "Tensor points, Tensor noise, Tensor? shared, Tensor origin, Tensor inside, Tensor slot, {layers}, "
    "float resolution, int width, bool has_rays, float[] settings"
)
_SOURCE = "fusion/fusion.cpp"


class _Settings(ctypes.Structure):
    """`Settings` of point.h."""

    _fields_ = (
        *((name, ctypes.c_float) for name in ("resolution", "relief", "gate", "max_gate_std", "floor")),
        *((name, ctypes.c_float) for name in ("outlier_variance", "max_support", "max_variance")),
        *((name, ctypes.c_int32) for name in ("min_above", "max_above_per_scan", "min_challengers")),
        *((name, ctypes.c_int32) for name in ("has_rays", "has_edges", "min_points", "min_extreme", "refinements")),
        *((name, ctypes.c_float) for name in ("min_share", "min_passed", "margin", "min_settled")),
    )


def can_update_in_cpp(state: MapState) -> bool:
    """Tell whether `update_in_cpp` takes the state: float32 on a CPU, without a gradient."""
    return has_one_pass(state) and can_select(state.elevation)


def update_in_cpp(
    points: HitPoints, layers: list[Tensor], grid: GridConfig, cfg: FusionConfig, has_rays: bool
) -> Update:
    """Do what `update_all` does, in place: `layers` are those of `CellLayers`, contiguous (B, H, W), masks as bytes."""
    hits = (*points[:-1], as_bytes(points.cells.inside), points.cells.slot)
    num_used, num_ignored = _update(*hits, layers, grid.resolution, grid.width, has_rays, numbers(cfg))
    return Update(CellLayers(**named(CellLayers._fields, layers)), num_used, num_ignored)


def numbers(cfg: FusionConfig) -> list[float]:
    """Return the settings as numbers, as operators take them; those of the edges last."""
    *values, edges = (getattr(cfg, field.name) for field in fields(cfg))
    of_edges = [] if edges is None else [getattr(edges, field.name) for field in fields(edges)]
    return [float(value) for value in (*values, *of_edges)]


@functools.lru_cache(maxsize=64)  # as it is asked for in every update
def config_of(settings: tuple[float, ...]) -> FusionConfig:
    """Return the settings that `numbers` made numbers of."""
    *own, _ = fields(FusionConfig)
    of_edges = fields(EdgeConfig) if len(settings) > len(own) else ()
    pairs = zip((*own, *of_edges), settings, strict=True)
    values = [int(value) if isinstance(field.default, int) else value for field, value in pairs]
    edges: dict[str, Any] = {field.name: value for field, value in zip(of_edges, values[len(own) :], strict=True)}
    named: dict[str, Any] = {field.name: value for field, value in zip(own, values, strict=False)}
    return FusionConfig(**named, edges=EdgeConfig(**edges) if edges else None)


def new_tallies(points: Tensor, noise: Tensor, shared: Tensor | None, *others: Any) -> tuple[Tensor, Tensor]:
    """Return memory for the numbers of points used and ignored (B,)."""
    _, _, slot, *_ = others
    return slot.new_empty(slot.shape[0]), slot.new_empty(slot.shape[0])


@operator(f"update_cells({ARGUMENTS.format(layers='Tensor(a!)[] layers')}) -> (Tensor, Tensor)", new_tallies)
def _update(
    points: Tensor,
    noise: Tensor,
    shared: Tensor | None,
    origin: Tensor,
    inside: Tensor,
    slot: Tensor,
    layers: list[Tensor],
    resolution: float,
    width: int,
    has_rays: bool,
    settings: list[float],
) -> tuple[Tensor, Tensor]:
    """Update contiguous layers, masks as bytes, in place, and return the points used and ignored (B,)."""
    library, cfg = load(_SOURCE, {}), config_of(tuple(settings))
    (B, M), C = slot.shape, layers[0].shape[1:].numel()
    if library is None:
        hits = HitPoints(points, noise, shared, origin, PointCells(slot, as_mask(inside), C))
        return _update_by_tensors(hits, layers, resolution, width, cfg, has_rays)
    tallies = new_tallies(points, noise, shared, origin, inside, slot)
    read = [points, noise, shared, origin, inside, slot]
    own = c_settings(cfg, resolution, has_rays)
    run(library.fuse_points, read, [*layers, *tallies], B, M, origin.shape[1], C // width, width, ctypes.byref(own))
    return tallies


def _update_by_tensors(
    points: HitPoints, layers: list[Tensor], resolution: float, width: int, cfg: FusionConfig, has_rays: bool
) -> tuple[Tensor, Tensor]:
    """Do the same without a compiler."""
    before = CellLayers(*(layer.flatten(1) for layer in layers))
    before = before._replace(validity=as_mask(before.validity))
    grid = grid_of((points.cells.num_cells // width, width), resolution)
    new = update_all(points, before, grid, cfg, has_rays)
    for layer, value in zip(layers, new.layers, strict=True):
        layer.copy_(value.view(layer.shape))
    return new.num_used, new.num_ignored


@functools.lru_cache(maxsize=64)
def c_settings(cfg: FusionConfig, resolution: float, has_rays: bool) -> ctypes.Structure:
    """Return the settings as point.h defines them."""
    edges = cfg.edges or EdgeConfig(margin=0.0, min_settled=0.0)
    names = [field[0] for field in _Settings._fields_]
    of_edges = {name: getattr(edges, name) for name in names if hasattr(edges, name)}
    own = {name: getattr(cfg, name) for name in names if hasattr(cfg, name)}
    given = {"resolution": resolution, "relief": cfg.relief * resolution, "floor": cfg.scan_variance_floor}
    flags = {"min_challengers": MIN_CHALLENGERS, "has_rays": has_rays, "has_edges": cfg.edges is not None}
    values = (own | of_edges | given | flags).items()
    # C's integers have 32 bits.
    return _Settings(**{name: min(v, 2**31 - 1) if isinstance(v, int) else v for name, v in values})
