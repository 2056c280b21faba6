"""Compute the values of a height scan from its settings and the map: by tensors here, or in C++ (`kernel`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.layers import Layer, sample_lowest
from torchelev.levels import HINT as LEVEL_HINT
from torchelev.levels.state import Levels
from torchelev.observations.channel_reading import read_channels
from torchelev.observations.fill import ORIGINAL, Query, fill_unknown, filled_layers, read_points
from torchelev.observations.inputs import ScanInputs, check_base, check_feet, draw_noise
from torchelev.observations.patterns import to_cells
from torchelev.observations.scan.kernel import can_read, read_in_cpp
from torchelev.observations.scan.settings import ScanSettings
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Float


def read_scan(
    scan: ScanSettings,
    emap: ElevationMap,
    T_map_base: Tensor,
    feet: Tensor | None,
    noise: bool | Tensor,
    state: MapState | None,
    levels: Levels | None,
) -> Layer:
    """Read the values of a scan, (B, P) or with channels (B, 1 + C, P), and where they are known: see `HeightScan`."""
    scan.placement.require_inside(emap.cfg.grid)
    T_map_base = check_base(emap, T_map_base)
    if scan.num_feet:
        feet = check_feet(emap, feet, scan.num_feet)
    else:
        require(feet is None, "feet", "must be left out", "feet for a scan around the base", "use HeightScan.feet")
    draws = draw_noise(emap, noise, scan.num_points, scan.noise)
    current = emap.state if state is None else state
    inputs = ScanInputs(current, emap.cfg.grid, T_map_base, feet, draws)
    fill = scan.original if scan.fill == ORIGINAL else scan.fill
    if scan.surface == "ceiling":
        actual = "'ceiling' of a map without"
        require(emap.levels is not None, "surface", "needs a map with levels", actual, LEVEL_HINT)
        heights = _read_ceiling(scan, inputs, emap.read_layer("ceiling", state, levels))
    elif can_read(fill, inputs):
        heights = read_in_cpp(scan, fill, _value_of_unknown(scan, fill), inputs)
    else:
        filled = filled_layers(fill, emap, state, scan.placement.half_extent(inputs.grid), scan.inpaint_rings)
        heights = _read(scan, fill, filled, inputs)
    if not scan.channels:
        return heights
    channels = read_channels(scan.channels, scan.channel_fill, emap, _place(scan, inputs), state)
    values, valid = (torch.cat([height[:, None], rows], 1) for height, rows in zip(heights, channels, strict=True))
    return values, valid


def _place(scan: ScanSettings, inputs: ScanInputs) -> Float[Tensor, "B P 2"]:
    """Return the points of a scan, in cells from the window's corner."""
    origin = inputs.T_map_base[:, None, :3, 3] if inputs.feet is None else inputs.feet
    state = inputs.state
    return scan.placement.place(inputs.T_map_base, origin, state.corner, inputs.grid.resolution, state.elevation.dtype)


def _read_ceiling(scan: ScanSettings, inputs: ScanInputs, layer: Layer) -> Layer:
    """Read the heights of the ceiling above the base or the feet."""
    ceiling, known = sample_lowest(layer, _place(scan, inputs), inputs.grid, scan.mode)
    origin = inputs.T_map_base[:, None, :3, 3] if inputs.feet is None else inputs.feet
    z = origin[..., 2:].to(ceiling.dtype).expand(-1, -1, len(scan.pattern)).flatten(1)
    known = known & torch.isfinite(z)
    value = torch.where(known, ceiling - z, torch.inf).clamp(max=scan.no_ceiling)
    return _finish(scan, value, inputs.draws), known


def _read(scan: ScanSettings, fill: str | float, layers: list[Layer], inputs: ScanInputs) -> Layer:
    """Read a scan; `layers` are those of `filled_layers`."""
    state, grid = inputs.state, inputs.grid
    dtype = state.elevation.dtype
    base = inputs.T_map_base[:, None, :3, 3]
    origin = base if inputs.feet is None else inputs.feet
    uv = _place(scan, inputs)
    base_uv, base_z = to_cells(base, state.corner, grid.resolution, dtype), base[..., 2].to(dtype)
    query = Query(uv, base_uv, base_z, scan.placement.half_extent(grid), grid)
    z = origin[..., 2:].to(dtype)
    # On a GPU the poses are not checked: they may not be finite.
    z, is_finite = (v.expand(-1, -1, len(scan.pattern)).flatten(1) for v in (z, torch.isfinite(z)))
    (elevation, known), *filled = read_points([(state.elevation, state.validity), *layers], uv, grid, scan.mode)
    valid = known & is_finite
    ground, has_ground = fill_unknown(fill, state, query, (elevation, valid), filled)
    missing = _value_of_unknown(scan, fill)
    value = torch.where(has_ground & is_finite, z - ground - scan.nominal_height, missing)
    return _finish(scan, value, inputs.draws), valid


def _value_of_unknown(scan: ScanSettings, fill: str | float) -> float:
    """Return what a point reads for which neither the map nor the fill has a height [m]."""
    if isinstance(fill, int | float):
        return fill
    standing_height = scan.nominal_height if scan.standing_height is None else scan.standing_height
    return standing_height - scan.nominal_height


def _finish(scan: ScanSettings, value: Tensor, draws: Tensor | None) -> Tensor:
    """Apply noise, clip and scale."""
    error = None if draws is None else (2 * draws - 1) * scan.noise
    if error is not None and not scan.noise_after_clip:
        value = value + error
    if scan.clip is not None:
        value = value.clamp(-scan.clip, scan.clip)
    if error is not None and scan.noise_after_clip:
        value = value + error
    return value * scan.scale
