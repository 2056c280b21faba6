"""The cells below footprints, and the map's values there."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.grid import GridConfig
from torchelev.inputs.checks import FLOATS, check_tensor
from torchelev.ops.transforms import is_readable
from torchelev.plane_fit import solve_gradient, spans_plane
from torchelev.planning.limits import compute_steps
from torchelev.planning.polygons import PolygonCells, rasterize
from torchelev.planning.standing import MAX_CELL_OFFSET, mark_standing_cells
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

ROUNDING = 1e-3  # [cells] tolerance on a polygon's extent


class GroundBelow(NamedTuple):
    """The cells below footprints."""

    cells: PolygonCells  #: of each polygon
    values: Float[Tensor, "B P S S"]  #: of the layer, 0 where not known
    known: Bool[Tensor, "B P S S"]  #: in the polygon and known
    assumed: Bool[Tensor, "B P S S"]  #: in the polygon, unknown, and under the robot where it stands now
    steps: Float[Tensor, "B P S S"]  #: [m] of the cells in the polygon, 0 elsewhere
    height: Float[Tensor, "B P S S"]  #: [m] elevation, 0 where not measured
    measured: Bool[Tensor, "B P S S"]  #: in the polygon, and the elevation is known


def read_ground(
    emap: ElevationMap,
    polygons: Tensor,
    layer: str,
    max_extent: float,
    state: MapState | None,
    standing: Tensor | None = None,
) -> GroundBelow:
    """Check the inputs and read the cells below polygons of at most `max_extent` [m] along x and y."""
    is_rated = layer != "traversability" or emap.cfg.traversability is not None
    hint = "give ElevationMapConfig a TraversabilityConfig, or FootprintConfig another layer"
    require(is_rated, "traversability", "must not be switched off", "None", hint)
    values, known = emap.read_layer(layer, state)
    current, grid = emap.state if state is None else state, emap.cfg.grid
    uv, is_usable = _to_cells(emap, polygons, max_extent, current.corner)
    cells = rasterize(torch.where(is_usable[..., None, None], uv, 0.0), _max_cells(max_extent, grid) + 1)
    cells = cells._replace(inside=cells.inside & is_usable[..., None, None])
    assumed = torch.zeros_like(cells.inside)
    if standing is not None:
        below = mark_standing_cells(emap, standing, state) & ~known
        assumed = read_patches(values, below, cells, grid)[1]
    values, known = read_patches(values, known, cells, grid)
    elevation = current.elevation.detach().to(torch.promote_types(current.elevation.dtype, torch.float32))
    height, measured = read_patches(elevation, current.validity, cells, grid)
    steps = compute_steps(elevation, current.validity, grid.resolution)
    steps, _ = read_patches(steps, torch.ones_like(current.validity), cells, grid)
    return GroundBelow(cells, values, known, assumed, steps, height, measured)


def _to_cells(emap: ElevationMap, polygons: Tensor, max_extent: float, corner: Tensor) -> tuple[Tensor, Tensor]:
    """Return the vertices in cells from the window's corner, and which polygons are finite and small enough."""
    value = check_tensor("polygons", polygons, emap.device, FLOATS)
    fits = value.ndim == 4 and value.shape[0] == emap.num_envs and value.shape[3] == 2
    hint = "give x and y of polygons for each environment"
    require(fits, "polygons", f"expected ({emap.num_envs}, P, V, 2)", tuple(value.shape), hint)
    hint = "give the vertices in order, or repeat the last one"
    require(value.shape[2] >= 3, "polygons", "must have at least 3 vertices", value.shape[2], hint)
    grid = emap.cfg.grid
    max_cells = _max_cells(max_extent, grid) + ROUNDING
    uv = value.detach().double() / grid.resolution - corner[:, None, None]
    extent = (uv.amax(-2) - uv.amin(-2)).amax(-1)
    if is_readable(value, emap.check_values) and value.numel():
        _require_small(uv, extent * grid.resolution, max_cells * grid.resolution, max_extent)
    return uv, (uv.abs() < MAX_CELL_OFFSET).flatten(-2).all(-1) & (extent <= max_cells)


def _max_cells(max_extent: float, grid: GridConfig) -> int:
    """Return `max_extent` in cells, rounded up."""
    return math.ceil(max_extent / grid.resolution - 1e-6)


def _require_small(uv: Tensor, extent: Tensor, largest_extent: float, max_extent: float) -> None:
    """Refuse polygons that are not finite or too large; this reads their values."""
    is_finite = bool(torch.isfinite(uv).all())
    require(is_finite, "polygons", "must be finite", "NaN or inf", "pad by repeating the last vertex, not with NaN")
    largest = float(extent.max())
    rule = f"must extend at most max_extent = {max_extent:g} m along x and y"
    hint = "enlarge max_extent of FootprintConfig, or divide the polygon"
    require(largest <= largest_extent, "polygons", rule, f"{largest:.6g} m", hint)


def read_patches(values: Tensor, known: Tensor, cells: PolygonCells, grid: GridConfig) -> tuple[Tensor, Tensor]:
    """Read the polygons' cells: their values, 0 where not known, and where they are known."""
    offset = torch.arange(cells.inside.shape[-1], device=values.device)
    i, j = cells.first[..., 0, None] + offset, cells.first[..., 1, None] + offset
    in_rows, in_columns = (i >= 0) & (i < grid.height), (j >= 0) & (j < grid.width)
    i, j = i.clamp(0, grid.height - 1) * grid.width, j.clamp(0, grid.width - 1)
    cell = (i[..., :, None] + j[..., None, :]).flatten(1)
    is_known = known.flatten(1).gather(1, cell).view_as(cells.inside)
    is_known = is_known & cells.inside & in_rows[..., :, None] & in_columns[..., None, :]
    return torch.where(is_known, values.flatten(1).gather(1, cell).view_as(is_known), 0.0), is_known


def fit_below(ground: GroundBelow, resolution: float) -> tuple[Tensor, Tensor]:
    """Fit planes to the measured cells of each footprint.

    Returns:
        slope: (B, P) [rad], the inclination of the plane through all of them.
        rise: (B, P) [m], how far the highest cell is above the plane through the outer ones, where the feet are: those
            at least sqrt(1/2) times as far from the middle as the farthest. Both are 0 without a plane.
    """
    n = ground.measured.to(ground.height.dtype)
    offset = torch.arange(n.shape[-1], device=n.device, dtype=n.dtype).expand_as(n)
    u, v, z = (_centred(values, n) for values in (offset.mT, offset, ground.height))
    gu, gv, _ = _fit(u, v, z, n)
    slope = torch.atan(torch.hypot(gu, gv) / resolution)
    distance = (u.square() + v.square()) * n
    outer = n * (distance >= 0.5 * distance.amax((-2, -1), keepdim=True))
    u, v, z = (_centred(values, outer) for values in (u, v, z))
    gu, gv, spans = _fit(u, v, z, outer)
    above = torch.where(ground.measured, z - gu[..., None, None] * u - gv[..., None, None] * v, 0.0)
    return slope, torch.where(spans, above.flatten(-2).amax(-1), 0.0).clamp(min=0)


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum((-2, -1)) / weight.sum((-2, -1)).clamp(min=1)


def _centred(values: Tensor, weight: Tensor) -> Tensor:
    return values - _mean(values, weight)[..., None, None]


def _fit(u: Tensor, v: Tensor, z: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradient [m per cell] of the plane through cells, 0 without one, and whether they span one."""
    uu, uv, vv, uz, vz = (_mean(product, weight) for product in (u * u, u * v, v * v, u * z, v * z))
    spans = spans_plane(uu, uv, vv, 1)
    gu, gv = (torch.where(spans, part, 0.0) for part in solve_gradient(uu, uv, vv, uz, vz))
    return gu, gv, spans
