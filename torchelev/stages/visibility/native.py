"""The visibility clean-up in C++ (`torchelev/native/visibility`): the same to rounding, and faster."""

from __future__ import annotations

import ctypes
import functools
import math
from typing import Any

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.native.library import as_defines, call, load
from torchelev.ops.masks import NOWHERE
from torchelev.ops.transforms import is_transforming
from torchelev.stages.cells import first_center, lattice_offset
from torchelev.stages.visibility import accepted_rays
from torchelev.stages.visibility.config import RaycastConfig
from torchelev.stages.visibility.polar_table import PolarGrid
from torchelev.state import MapState, Measurement

_FLOATS = {
    "NOWHERE": NOWHERE,
    "NO_FALL": accepted_rays.NO_FALL,
    "NO_RAY": accepted_rays.NO_RAY,
    "CLEARANCE": accepted_rays.CLEARANCE,
}
_DOUBLES = {"NEAR": accepted_rays.NEAR, "SQRT_HALF": math.sqrt(0.5)}
_EXACT = "-ffp-contract=off"  # rounds after each operation, as tensors do
_CONSTANTS = as_defines(_FLOATS, _DOUBLES)
_CHANGED = ("validity", "challenger_support", "upper_bound", "bounded")
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
    return load("visibility/visibility.cpp", _CONSTANTS, _EXACT)


def can_run(state: MapState, m: Measurement) -> bool:
    """Tell whether C++ may do the clean-up: uncompiled, on a CPU, in float32, without gradients."""
    if torch.compiler.is_compiling() or is_transforming():  # graphs that stay whole are faster
        return False
    floats = [value for value in (*state[:-1], m.points, m.variance, m.origin) if value.is_floating_point()]
    is_differentiated = torch.is_grad_enabled() and any(value.requires_grad for value in floats)
    is_plain = type(state.elevation) is Tensor and state.elevation.device.type == "cpu"
    fits = is_plain and state.elevation.dtype == m.points.dtype == torch.float32
    return fits and not is_differentiated and _library() is not None


def cast_rays(state: MapState, m: Measurement, polar: PolarGrid, grid: GridConfig, cfg: RaycastConfig) -> MapState:
    """Return the state after the rays of all sensors were cast, where `can_run` says so."""
    library = _library()
    assert library is not None
    (B, H, W), S = state.elevation.shape, m.origin.shape[1]
    changed: dict[str, Any] = {
        name: getattr(state, name).clone(memory_format=torch.contiguous_format) for name in _CHANGED
    }
    read = [getattr(state, name) for name in _READ]
    seen = [m.points, m.variance, m.used, m.casts, m.origin, lattice_offset(state, m, grid), first_center(state, m)]
    tensors = [value.contiguous() for value in (*read, *changed.values(), *seen)]
    pointers = [ctypes.c_void_p(value.data_ptr()) for value in tensors]
    thresholds = cfg.min_time, cfg.min_incidence, cfg.min_support, cfg.gate
    settings = _Settings(H, W, grid.resolution, *thresholds, torch.get_num_threads())
    table, sizes = _polar(polar)[0], (B, S, m.points.shape[1] // max(S, 1))
    call(library.clear_seen_through, *pointers, ctypes.byref(table), ctypes.byref(settings), *sizes)
    return state._replace(**changed)


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
