"""Height scans in C++ (`scan.cpp`), for float32 on a CPU without gradients: the same values as by tensors."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from torchelev.kernels.cpu_build import call, load
from torchelev.layers import Layer
from torchelev.observations.fill import MODES
from torchelev.observations.ground import border_left_out, count_near_levels, margin_around
from torchelev.observations.inputs import ScanInputs
from torchelev.observations.patterns import ALIGNMENTS
from torchelev.observations.scan.settings import ScanSettings
from torchelev.ops.transforms import can_compute_unseen

LIBRARY: tuple[str, dict[str, str]] = ("observations/kernel/scan.cpp", {})
_RULES = ("ground", "lowest", "upper_bound", "inpaint")  # `Fill` of scan.cpp; the others fill in no heights
_ARRAYS = ("pose", "feet", "corner", "pattern", "elevation", "validity", "upper_bound", "bounded", "draws")
_SIZES = ("environments", "origins", "points", "height", "width", "top", "left")
_SETTINGS = ("mode", "alignment", "fill", "is_single", "num_near", "rings", "noise_after_clip")


class _Scan(ctypes.Structure):
    """`Scan` of scan.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in (*_ARRAYS, "values", "valid")),
        ("resolution", ctypes.c_double),
        *((name, ctypes.c_int64) for name in _SIZES),
        *((name, ctypes.c_int32) for name in _SETTINGS),
        *((name, ctypes.c_float) for name in ("nominal_height", "missing", "clip", "scale", "noise")),
    )


def can_read(fill: str | float, inputs: ScanInputs) -> bool:
    """Return whether `read_in_cpp` takes the inputs: float32 on a CPU, with nothing to differentiate or to trace."""
    state, grid = inputs.state, inputs.grid
    floats = (state.elevation, state.upper_bound, *(() if inputs.draws is None else (inputs.draws,)))
    cells = (len(inputs.T_map_base), grid.height, grid.width)
    fits = all(layer.shape == cells for layer in (*floats[:2], state.validity, state.bounded))
    fits = fits and state.corner.shape == (cells[0], 2) and all(value.dtype == torch.float32 for value in floats)
    read = (*floats, state.corner, inputs.T_map_base, *(() if inputs.feet is None else (inputs.feet,)))
    return fits and can_compute_unseen(read) and load(*LIBRARY) is not None


def read_in_cpp(scan: ScanSettings, fill: str | float, missing: float, inputs: ScanInputs) -> Layer:
    """Read a scan; `missing` is the value [m] of points for which neither the map nor the fill has a height."""
    library = load(*LIBRARY)
    assert library is not None, "asked without `can_read`"
    state, pose = inputs.state, inputs.T_map_base.double()
    values = state.elevation.new_empty(len(pose), scan.num_points)
    valid = torch.empty_like(values, dtype=torch.bool)
    feet = None if inputs.feet is None else inputs.feet.double()
    pattern = scan.placement.on(values.device, values.dtype)
    layers = (state.elevation, state.validity, state.upper_bound, state.bounded)
    read = [*map(_contiguous, (pose, feet, state.corner, pattern, *layers, inputs.draws))]
    settings = _Scan(
        *(None if value is None else value.data_ptr() for value in (*read, values, valid)),
        *_sizes(scan, fill, inputs),
        *(scan.nominal_height, missing, torch.inf if scan.clip is None else scan.clip, scan.scale, scan.noise),
    )
    call(library.read_height_scans, ctypes.byref(settings), torch.get_num_threads())
    return values, valid


def _contiguous(value: Tensor | None) -> Tensor | None:
    return None if value is None else value.contiguous()


def _sizes(scan: ScanSettings, fill: str | float, inputs: ScanInputs) -> tuple[float, ...]:
    """Return the resolution, the sizes and the settings of `_Scan` that are whole numbers."""
    grid, size = inputs.grid, (inputs.grid.height, inputs.grid.width)
    margin = scan.inpaint_rings if fill == "inpaint" else margin_around(grid)
    border = border_left_out(size, scan.placement.half_extent(grid), margin)
    counts = (len(inputs.T_map_base), max(1, scan.num_feet), len(scan.pattern))
    rule = 1 + _RULES.index(fill) if isinstance(fill, str) and fill in _RULES else 0
    choices = (MODES.index(scan.mode), ALIGNMENTS.index(scan.alignment), rule)
    is_single = inputs.T_map_base.dtype == torch.float32
    rest = (is_single, count_near_levels(grid), scan.inpaint_rings, scan.noise_after_clip)
    return (grid.resolution, *counts, *size, *border, *choices, *rest)
