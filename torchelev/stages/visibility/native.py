"""The visibility clean-up in C++ (`torchelev/native/visibility`): the same to rounding, and faster."""

from __future__ import annotations

import ctypes
import functools
import math
from typing import Any

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.native.library import call, load
from torchelev.ops.masks import NOWHERE
from torchelev.stages.visibility import accepted_rays
from torchelev.stages.visibility.config import RaycastConfig
from torchelev.stages.visibility.polar_table import PolarGrid
from torchelev.state import MapState, Measurement

NO_RAY = 1e4  # a slope above every ray's
_FLOATS = {
    "NOWHERE": NOWHERE,
    "NO_FALL": accepted_rays.NO_FALL,
    "NO_RAY": NO_RAY,
    "CLEARANCE": accepted_rays.CLEARANCE,
}
_DOUBLES = {"NEAR": accepted_rays.NEAR, "SQRT_HALF": math.sqrt(0.5)}
_EXACT = "-ffp-contract=off"  # rounds after each operation, as tensors do
CHANGED = ("validity", "challenger_support", "upper_bound", "bounded")
_READ = ("elevation", "variance", "support", "challenger", "time", "gradient_x", "gradient_y")


class _Polar(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int) for name in ("ranges", "azimuths", "num_levels")),
        *((name, ctypes.c_void_p) for name in ("widen", "width", "entry")),
        *((name, ctypes.c_int) for name in ("near_ranges", "near_azimuths")),
        *((name, ctypes.c_void_p) for name in ("near_cosine", "near_sine")),
    ]


class _Settings(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int) for name in ("H", "W")),
        *((name, ctypes.c_double) for name in ("resolution", "min_time", "min_incidence", "min_support", "gate")),
        ("num_threads", ctypes.c_int),
    ]


def _library() -> ctypes.CDLL | None:
    defines = {name: f"{value!r}f" for name, value in _FLOATS.items()}
    return load("visibility/visibility.cpp", defines | {name: repr(value) for name, value in _DOUBLES.items()}, _EXACT)


def can_run(state: MapState, m: Measurement) -> bool:
    """Tell whether C++ may do the clean-up: uncompiled, on a CPU, in float32, without gradients."""
    floats = [value for value in (*state[:-1], m.points, m.variance, m.origin) if value.is_floating_point()]
    is_differentiated = torch.is_grad_enabled() and any(value.requires_grad for value in floats)
    is_plain = (
        not torch.compiler.is_compiling() and type(state.elevation) is Tensor
    )  # graphs that stay whole are faster
    fits = state.elevation.device.type == "cpu" and state.elevation.dtype == m.points.dtype == torch.float32
    return fits and is_plain and not is_differentiated and _library() is not None


def clear_seen_through(
    layers: list[Tensor],
    changed: list[Tensor],
    points: list[Tensor],
    origin: Tensor,
    offset: Tensor,
    center: Tensor,
    polar: list[int],
    bins: float,
    cfg: list[float],
) -> list[Tensor]:
    """Return the layers CHANGED after the rays of all sensors were cast.

    Args:
        layers: (B, H, W) of the names _READ.
        changed: (B, H, W) of the names CHANGED.
        points: (B, M, ...) points, variances, used and casts.
        origin: (B, S, 3) [m] the sensors.
        offset: (B, 2) [m] of the measurement's origin in the window.
        center: (B, 2) [cells] of the first cell's centre from the measurement's origin.
        polar: ranges, azimuths and widening of the `PolarGrid`.
        bins: of the `PolarGrid`.
        cfg: resolution, and the fields of `RaycastConfig` in the order of `_Settings`.
    """
    library = _library()
    assert library is not None
    B, H, W = layers[0].shape
    S, num_points = origin.shape[1], points[0].shape[1] // max(origin.shape[1], 1)
    new = [layer.clone(memory_format=torch.contiguous_format) for layer in changed]
    read = [value.contiguous() for value in layers]
    inputs = [value.contiguous() for value in (*points, origin, offset, center)]
    pointers = [ctypes.c_void_p(value.data_ptr()) for value in (*read, *new, *inputs)]
    table = _polar(PolarGrid(polar[0], polar[1], bins, tuple(polar[2:])))[0]
    settings = _Settings(H, W, *cfg, torch.get_num_threads())
    call(library.clear_seen_through, *pointers, ctypes.byref(table), ctypes.byref(settings), B, S, num_points)
    return new


@functools.cache
def _polar(polar: PolarGrid) -> tuple[_Polar, list[Tensor]]:
    """Return the table's size for C++, and the tensors that it points into."""
    width, entry = polar.covered(torch.arange(polar.ranges + 1, dtype=torch.float32))
    near_ranges, near_azimuths = accepted_rays.near_size(polar)
    cosine, sine = accepted_rays.directions(near_azimuths, width)
    tensors = [torch.tensor(polar.widen, dtype=torch.int32), width, entry, cosine, sine]
    tensors = [value.contiguous() for value in tensors]
    pointers = [value.data_ptr() for value in tensors]
    size = polar.ranges, polar.azimuths, len(polar.widen)
    return _Polar(*size, *pointers[:3], near_ranges, near_azimuths, *pointers[3:]), tensors


def clear(
    state: MapState, m: Measurement, offset: Tensor, center: Tensor, grid: GridConfig, cfg: RaycastConfig
) -> MapState:
    """Return the state after the clean-up."""
    polar = PolarGrid.of(grid, cfg)
    new = clear_seen_through(
        [getattr(state, name) for name in _READ],
        [getattr(state, name) for name in CHANGED],
        [m.points, m.variance, m.used, m.casts],
        m.origin,
        offset,
        center,
        [polar.ranges, polar.azimuths, *polar.widen],
        polar.bins,
        [grid.resolution, cfg.min_time, cfg.min_incidence, cfg.min_support, cfg.gate],
    )
    changed: dict[str, Any] = dict(zip(CHANGED, new, strict=True))
    return state._replace(**changed)
