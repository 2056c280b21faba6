"""Levels in C++ (`levels.cpp`), for float32 maps on a CPU: the same as by tensors (`step.py`)."""

from __future__ import annotations

import ctypes
import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.kernels.cpu_build import call, load
from torchelev.levels.rays import SightGrid
from torchelev.levels.state import SURFACE, Levels, LevelStatistics
from torchelev.ops.transforms import can_compute_unseen
from torchelev.stages.measure.config import BodyConfig
from torchelev.stages.measure.stage import find_own
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Int

    from torchelev.config import ElevationMapConfig
    from torchelev.inputs.update_inputs import Inputs

LIBRARY: tuple[str, dict[str, str]] = ("levels/kernel/levels.cpp", {})

_GROUND = ("elevation", "variance", "validity", "support", "challenger_support", "time", "bounded")
_ADDRESSES = (
    *("points", "T_map_sensor", "T_map_base", "variance", "own", "dt", "corner"),
    *(f"ground_{name}" for name in _GROUND),
    *("disagreement", "before", *(f"level_{name}" for name in SURFACE), "free_top", "is_open", "aside", "statistics"),
)
_SENSOR = ("noise_factor", "noise_floor", "min_distance", "max_distance")
_NUMBERS = (
    *("variance_rate", "max_variance", "max_support", "variance_floor"),
    *("min_gap", "max_step", "min_support", "min_time", "overlap_height", "overlap_radius"),
)


class _Update(ctypes.Structure):
    """`Update` of kernel/update.h."""

    _fields_ = (
        *((f"at_{name}", ctypes.c_void_p) for name in _ADDRESSES),
        *((name, ctypes.c_int64) for name in "BSNHWL"),
        ("resolution", ctypes.c_double),
        *((name, ctypes.c_float) for name in _SENSOR),
        ("box", ctypes.c_float * 6),
        ("ramp", ctypes.c_float * 4),
        *((name, ctypes.c_float) for name in _NUMBERS),
        *((name, ctypes.c_int32) for name in ("has_box", "has_ramp", "by_gap", "max_blind")),
        *((name, ctypes.c_int32) for name in ("azimuths", "elevations", "ranges")),
    )


def can_update(levels: Levels, state: MapState, cfg: ElevationMapConfig) -> bool:
    """Return whether `update_in_cpp` takes these: float32 on a CPU, with nothing to differentiate or to trace."""
    tensors = (*levels, *(getattr(state, name) for name in _GROUND))
    is_plain = all(value.is_contiguous() for value in tensors) and state.elevation.dtype == torch.float32
    is_plain = is_plain and levels.lower.dtype == torch.float32 and cfg.sensor.depth is None
    return is_plain and can_compute_unseen(tensors) and load(*LIBRARY) is not None


def update_in_cpp(
    levels: Levels, corner: Int[Tensor, "B 2"], state: MapState, inputs: Inputs, cfg: ElevationMapConfig
) -> tuple[Bool[Tensor, "B S N"], LevelStatistics]:
    """Update levels and the ground of maps, in place.

    Args:
        levels: in rings, see `Levels`.
        corner: of their windows before.
        state: of the maps, recentred for this update.
        inputs: of the update.
        cfg: of the maps.

    Returns:
        The points that do not measure the ground, and the numbers of surfaces.
    """
    library = load(*LIBRARY)
    assert library is not None, "asked without `can_update`"
    B, S, N = inputs.points.shape[:3]
    aside = torch.zeros(B, S, N, dtype=torch.bool)
    numbers = torch.zeros(B, len(LevelStatistics._fields), dtype=torch.int64)
    variance = None if inputs.variance is None else inputs.variance.float()
    base = None if inputs.T_map_base is None else inputs.T_map_base.double()
    given: tuple[Tensor | None, ...] = (inputs.points.float(), inputs.T_map_sensor.double(), base, variance)
    given = (*given, find_own(inputs, cfg.sensor), inputs.dt.float(), state.corner)
    read = [None if value is None else value.contiguous() for value in given]
    ground = (getattr(state, name) for name in _GROUND)
    tensors = (*read, *ground, state.statistics.disagreement, corner, *levels, aside, numbers)
    addresses = (None if value is None else value.data_ptr() for value in tensors)
    sizes = (B, S, N, cfg.grid.height, cfg.grid.width, levels.lower.shape[1])
    update = _Update(*addresses, *sizes, cfg.grid.resolution, *_settings(cfg))
    call(library.update_levels, ctypes.byref(update), torch.get_num_threads())
    return aside, LevelStatistics(*numbers.unbind(1))


def _settings(cfg: ElevationMapConfig) -> tuple[object, ...]:
    """Return what follows the sizes in `_Update`."""
    sensor, own, overlap, size = cfg.sensor, cfg.levels, cfg.overlap, SightGrid.of(cfg.grid)
    assert own is not None
    box = sensor.body if isinstance(sensor.body, BodyConfig) else None
    corners = (ctypes.c_float * 6)(*(() if box is None else (*box.lower, *box.upper)))
    ramp = sensor.exclusion
    slope = (ctypes.c_float * 4)(*(() if ramp is None else (ramp.slope, ramp.distance, ramp.offset, ramp.height)))
    fusion = (cfg.aging.variance_rate, cfg.fusion.max_variance, cfg.fusion.max_support, cfg.fusion.scan_variance_floor)
    min_time = math.inf if cfg.raycast is None else cfg.raycast.min_time
    floor = (0.0, 0.0) if overlap is None else (overlap.height, overlap.radius)
    numbers = (*fusion, own.min_gap, own.max_step, own.min_support, min_time, *floor)
    flags = (int(box is not None), int(ramp is not None), int(own.separation == "gap"), own.blind_cells(cfg.grid))
    of_sensor = (getattr(sensor, name) for name in _SENSOR)
    return (*of_sensor, corners, slope, *numbers, *flags, size.azimuths, size.elevations, size.ranges)
