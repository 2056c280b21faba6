"""The lowest rays and the cells below them in C++ (`torchelev/native/rays`): the same numbers as `clean_up`."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from torchelev.native.library import call, load
from torchelev.ops.masks import NOWHERE
from torchelev.stages.visibility.polar_table import NO_RAY, PolarGrid

_CONSTANTS = {"NO_RAY": f"{NO_RAY!r}f", "NOWHERE": f"{NOWHERE!r}f"}


def clear_and_bound(
    rays: Sequence[Tensor], view: Sequence[Tensor], layers: Sequence[Tensor], polar: PolarGrid, limits: Sequence[float]
) -> list[Tensor] | None:
    """Return what one sensor's rays make of the four layers that they change; None where C++ cannot compute it.

    Args:
        rays: range and azimuth bins, int32, and slopes, each (B, N).
        view: where the cells lie from the sensor, and its height [m]: (B, H, 1), (B, 1, W), (B, 1, 1).
        layers: in the order of `clean_up.READ`, masks as bytes.
        polar: the table's size.
        limits: resolution [m], min_time [s], min_incidence and gate.
    """
    elevation = layers[0]
    numbers = [rays[2], *view, *(layer for layer in layers if layer.dtype != torch.uint8)]
    is_plain = all(value.dtype == torch.float32 and value.device.type == "cpu" for value in numbers)
    if not is_plain or elevation.numel() == 0 or polar.azimuths * (polar.ranges + 64) >= 2**31:  # counted in 32 bits
        return None
    library = load("rays/rays.cpp", _CONSTANTS)
    if library is None:
        return None
    inputs = [value.contiguous() for value in (*rays, *view, *layers)]
    kinds = (torch.uint8, torch.uint8, elevation.dtype, torch.uint8)
    results = [torch.empty(elevation.shape, dtype=kind) for kind in kinds]
    pointers = [ctypes.c_void_p(tensor.data_ptr()) for tensor in (*inputs, *results)]
    sizes = [*rays[0].shape, *elevation.shape[1:], polar.ranges, polar.azimuths]
    widen = (ctypes.c_int64 * len(polar.widen))(*polar.widen)
    numbers_ = [ctypes.c_float(value) for value in (polar.bins, *limits)]
    whole = [ctypes.c_int64(size) for size in sizes]
    levels = ctypes.c_int64(len(polar.widen))
    call(library.clear_and_bound, *pointers, *whole, widen, levels, *numbers_, torch.get_num_threads())
    return results
