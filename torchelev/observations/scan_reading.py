"""Compute the values of a height scan from its settings and the map."""

from __future__ import annotations

import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.layers import Layer
from torchelev.observations.fill import ORIGINAL, Query, fill_unknown, filled_layers, read_points
from torchelev.observations.inputs import check_base, check_feet, draw_noise
from torchelev.observations.patterns import to_cells
from torchelev.observations.scan_settings import ScanSettings
from torchelev.state import MapState


def read_scan(
    scan: ScanSettings,
    emap: ElevationMap,
    T_map_base: Tensor,
    feet: Tensor | None,
    noise: bool | Tensor,
    state: MapState | None,
) -> Layer:
    """Read the values (B, P) of a scan, and whether the elevation at each point is known: see `HeightScan`."""
    grid = emap.cfg.grid
    scan.placement.require_inside(grid)
    T_map_base = check_base(emap, T_map_base)
    base = T_map_base[:, None, :3, 3]
    if not scan.num_feet:
        require(feet is None, "feet", "must be left out", "feet for a scan around the base", "use HeightScan.feet")
    origin = check_feet(emap, feet, scan.num_feet) if scan.num_feet else base
    error = draw_noise(emap, noise, scan.num_points, scan.noise)
    current = emap.state if state is None else state
    dtype = current.elevation.dtype
    uv = scan.placement.place(T_map_base, origin, current.corner, grid.resolution, dtype)
    base_uv, base_z = to_cells(base, current.corner, grid.resolution, dtype), base[..., 2].to(dtype)
    query = Query(uv, base_uv, base_z, scan.placement.half_extent(grid), grid)
    z = origin[..., 2:].to(dtype)
    # On a GPU the poses are not checked: they may not be finite.
    z, is_finite = (v.expand(-1, -1, len(scan.pattern)).flatten(1) for v in (z, torch.isfinite(z)))
    fill = scan.original if scan.fill == ORIGINAL else scan.fill
    layers = filled_layers(fill, emap, state, query.half_extent, scan.inpaint_rings)
    (elevation, known), *filled = read_points([(current.elevation, current.validity), *layers], uv, grid, scan.mode)
    valid = known & is_finite
    ground, has_ground = fill_unknown(fill, current, query, (elevation, valid), filled)
    standing_height = scan.nominal_height if scan.standing_height is None else scan.standing_height
    missing = standing_height - scan.nominal_height if isinstance(fill, str) else fill
    value = torch.where(has_ground & is_finite, z - ground - scan.nominal_height, missing)
    return _finish(scan, value, error), valid


def _finish(scan: ScanSettings, value: Tensor, error: Tensor | None) -> Tensor:
    """Apply noise, clip and scale."""
    if error is not None and not scan.noise_after_clip:
        value = value + error
    if scan.clip is not None:
        value = value.clamp(-scan.clip, scan.clip)
    if error is not None and scan.noise_after_clip:
        value = value + error
    return value * scan.scale
