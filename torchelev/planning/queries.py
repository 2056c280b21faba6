"""Questions to the map: the heights along a line, and a submap around a point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.checks import FLOATS, check_tensor, check_xy, readable
from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_count, whole_cells
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

FARTHEST = 2.0**30  # [cells] from the map frame's origin


class HeightProfile(NamedTuple):
    """What P points along each of M lines read, the ends included."""

    values: Float[Tensor, "B M P"]  #: 0 where not valid
    valid: Bool[Tensor, "B M P"]  #: the height is known
    distance: Float[Tensor, "B M P"]  #: [m] from the line's start, in the plane


class Submap(NamedTuple):
    """h x w cells of each map, on the map's own lattice. Index [i, j]: i grows with +x, j with +y."""

    layers: dict[str, Float[Tensor, "B h w"]]  #: by name, NaN where unknown or outside of the map
    center: Float[Tensor, "B 2"]  #: [m] of these cells, map frame, float64
    resolution: float  #: [m]


def height_profile(
    emap: ElevationMap,
    start: Float[Tensor, "B M 2"],
    end: Float[Tensor, "B M 2"],
    num_points: int,
    layer: str = "elevation",
    mode: str = "bilinear",
    *,
    state: MapState | None = None,
) -> HeightProfile:
    """Read a layer, as `ElevationMap.sample` does, at evenly spaced points from `start` to `end` [m], map frame.

    Differentiable in the state and, if bilinear, in the ends. A line with NaN or inf is valid nowhere, and its
    distances are 0: pad with them.

    Raises KeyError for an unknown layer; ValueError or TypeError for wrong shapes, dtypes and devices, another mode,
    and fewer than 2 points.
    """
    both = (("start", start), ("end", end))
    start, end = (check_xy(name, xy, emap.num_envs, emap.device).double() for name, xy in both)
    hint = "give each line a start and an end"
    require(start.shape == end.shape, "end", f"expected {tuple(start.shape)}", tuple(end.shape), hint)
    require_count("num_points", num_points, "give 2 for the ends alone", minimum=2)
    finite = torch.isfinite(start + end).all(-1, keepdim=True)
    start, way = torch.where(finite, start, torch.nan), torch.where(finite, end - start, 0.0)
    share = torch.arange(num_points, device=emap.device, dtype=torch.float64) / (num_points - 1)
    xy = start[:, :, None] + share[:, None] * way[:, :, None]
    values, valid = emap.sample(xy.flatten(1, 2), layer, mode, state=state)
    distance = torch.linalg.vector_norm(way, dim=-1, keepdim=True) * share
    return HeightProfile(values.view(distance.shape), valid.view(distance.shape), distance.to(values.dtype))


def submap(
    emap: ElevationMap,
    center_xy: Float[Tensor, "B 2"],
    length_x: float,
    length_y: float,
    layers: Sequence[str] = ("elevation",),
    *,
    state: MapState | None = None,
) -> Submap:
    """Copy whole cells of some layers around a point [m] of each map, map frame, without interpolation.

    The submap's centre lies within half a cell of the point. Its size [m] is the same for all maps, a whole number of
    cells; what lies outside of the map is unknown. Differentiable in the state.

    Raises KeyError for an unknown layer; ValueError or TypeError for another size, shape, dtype or device, and on a CPU
    for a point that is not finite. On other devices nothing is known around that.
    """
    grid = emap.cfg.grid
    h, w = (whole_cells(n, length, grid.resolution) for n, length in (("length_x", length_x), ("length_y", length_y)))
    hint = "give names such as ('elevation',)"
    require(not isinstance(layers, str) and len(layers) > 0, "layers", "must be one or more names", repr(layers), hint)
    found = {name: emap.read_layer(name, state) for name in layers}
    first = _first_cell(emap, center_xy, (h, w))
    corner = (emap.state if state is None else state).corner
    cell = _cells(emap, first - corner, (h, w))
    size = torch.stack([first.new_full((), cells) for cells in (h, w)])
    center = (first.double() + size.double() / 2) * grid.resolution
    return Submap({name: _read_cells(*layer, cell) for name, layer in found.items()}, center, grid.resolution)


def _first_cell(emap: ElevationMap, center_xy: object, shape: tuple[int, int]) -> Int[Tensor, "B 2"]:
    """Return the submap's cell [0, 0], as a cell number of the map frame's lattice."""
    value = check_tensor("center_xy", center_xy, emap.device, FLOATS)
    fits = tuple(value.shape) == (emap.num_envs, 2)
    require(
        fits, "center_xy", f"expected ({emap.num_envs}, 2)", tuple(value.shape), "give a point for each environment"
    )
    if readable(value, emap.check_values):
        finite = bool(torch.isfinite(value).all())
        require(finite, "center_xy", "must be finite", "NaN or inf", "give a point inside of the map")
    half = torch.stack([value.new_full((), cells / 2, dtype=torch.float64) for cells in shape])
    cell = torch.floor(value.detach().double() / emap.cfg.grid.resolution - half + 0.5)
    near = cell.abs() < FARTHEST
    return torch.where(near, cell, FARTHEST).to(torch.int64)


def _cells(emap: ElevationMap, first: Int[Tensor, "B 2"], shape: tuple[int, int]) -> Int[Tensor, "B h w"]:
    """Return the number of each of the submap's cells in the map; H * W where it is outside."""
    grid = emap.cfg.grid
    i, j = (first[:, axis, None] + torch.arange(shape[axis], device=first.device) for axis in (0, 1))
    rows, columns = (i >= 0) & (i < grid.height), (j >= 0) & (j < grid.width)
    inside = rows[:, :, None] & columns[:, None, :]
    return torch.where(inside, i[:, :, None] * grid.width + j[:, None, :], grid.num_cells)


def _read_cells(values: Tensor, known: Tensor, cell: Int[Tensor, "B h w"]) -> Float[Tensor, "B h w"]:
    layer = torch.where(known, values, torch.nan)
    return F.pad(layer.flatten(1), (0, 1), value=torch.nan).gather(1, cell.flatten(1)).view_as(cell)
