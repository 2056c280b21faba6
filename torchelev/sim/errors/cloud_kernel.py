"""Errors of clouds in C++ (`torchelev/sim/errors/kernel`), for float32 on a CPU without gradients: as by tensors."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from torchelev.kernels.cpu_build import call
from torchelev.sim.cpp_library import find_library

LIBRARY: tuple[str, dict[str, str]] = ("sim/errors/kernel/errors.cpp", {})
FIELDS = (  # of `SensorErrorConfig`, in the order of `Settings` in C++
    "flying",
    "flying_step",
    "too_short",
    "too_long",
    "range_constant",
    "range_quadratic",
    "range_step",
    "point_noise",
    "outliers",
    "outlier_noise",
    "disparity_step",
    "dropout",
    "missed_frames",
)
_POINTERS = "points settings flying artefact range_noise outlier point_noise missed dropped disturbed".split()


class _Clouds(ctypes.Structure):
    """`Clouds` of errors.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in _POINTERS),
        *((name, ctypes.c_int64) for name in ("B", "h", "w", "changes_ranges")),
    )


def disturb(
    points: Tensor,
    values: Tensor,
    names: Sequence[str],
    draws: Sequence[Tensor | None],
    image_shape: tuple[int, int],
    changes_ranges: bool,
) -> Tensor | None:
    """Do what `cloud_errors.disturb_in_torch` does; None where C++ cannot.

    Args:
        points: (B, M, 3) [m].
        values: The settings of each environment (B, len(names)).
        names: The fields of `SensorErrorConfig` that the settings belong to, FIELDS among them.
        draws: As in `cloud_errors.Draws`.
        image_shape: (h, w) of the points.
        changes_ranges: Whether any error moves points along their rays.
    """
    library = find_library(LIBRARY, points, values, *draws)
    if library is None:
        return None
    first = names.index(FIELDS[0])
    assert tuple(names[first : first + len(FIELDS)]) == FIELDS
    settings = values[:, first : first + len(FIELDS)].contiguous()
    points, disturbed = points.contiguous(), torch.empty_like(points, memory_format=torch.contiguous_format)
    pointers = [None if value is None else value.data_ptr() for value in (points, settings, *draws, disturbed)]
    clouds = _Clouds(*pointers, len(points), *image_shape, changes_ranges)
    call(library.disturb_clouds, ctypes.byref(clouds), torch.get_num_threads())
    return disturbed
