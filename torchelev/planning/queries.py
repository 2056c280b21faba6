"""Query a map: heights along lines, and submaps around points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require, require_count, whole_cells
from torchelev.inputs.checks import FLOATS, check_tensor, check_xy
from torchelev.ops.transforms import is_readable
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_MAX_CELL = 2.0**30  # from the map frame's origin; farther away, cell numbers may overflow


class HeightProfile(NamedTuple):
    """Values of a layer at P points along each of M lines, both ends included."""

    values: Float[Tensor, "B M P"]  #: 0 where not valid
    valid: Bool[Tensor, "B M P"]  #: the layer is known there
    distance: Float[Tensor, "B M P"]  #: [m] horizontal distance from the start of the line


class Submap(NamedTuple):
    """A window of h x w cells of each map, on the map's lattice. Index [i, j]: i grows with +x, j with +y."""

    layers: dict[str, Float[Tensor, "B h w"]]  #: by name; NaN where unknown or outside the map
    center: Float[Tensor, "B 2"]  #: [m] centre of the window, map frame, float64
    resolution: float  #: [m] side of a cell


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
    """Sample a layer at evenly spaced points along lines.

    Differentiable in the state and, in bilinear mode, in the ends of the lines.

    Args:
        emap: the maps.
        start: where the lines start [m], map frame. Pad lines with NaN: they are not valid and have distance 0.
        end: where the lines end [m], map frame.
        num_points: P, the points on each line, both ends included.
        layer: the layer to sample.
        mode: "bilinear" or "nearest", as in `ElevationMap.sample`.
        state: the state to read; None: that of the maps.

    Raises:
        ValueError, TypeError: for a wrong shape, dtype or device, an unknown mode, or fewer than 2 points.
        KeyError: for an unknown layer.
    """
    ends = (("start", start), ("end", end))
    start, end = (check_xy(name, xy, emap.num_envs, emap.device).double() for name, xy in ends)
    hint = "give each line a start and an end"
    require(start.shape == end.shape, "end", f"expected {tuple(start.shape)}", tuple(end.shape), hint)
    require_count("num_points", num_points, "give 2 for the two ends", 2)
    is_finite = torch.isfinite(start + end).all(-1, keepdim=True)
    start, line = torch.where(is_finite, start, torch.nan), torch.where(is_finite, end - start, 0.0)
    fraction = torch.arange(num_points, device=emap.device, dtype=torch.float64) / (num_points - 1)
    xy = start[:, :, None] + fraction[:, None] * line[:, :, None]
    values, valid = emap.sample(xy.flatten(1, 2), layer, mode, state=state)
    distance = torch.linalg.vector_norm(line, dim=-1, keepdim=True) * fraction
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
    """Copy the cells of some layers around a point of each map, without interpolation.

    The centre of the submap is within half a cell of the point. Cells outside the map are unknown. Differentiable in
    the state.

    Args:
        emap: the maps.
        center_xy: the points [m], map frame.
        length_x: size along x [m], a whole number of cells.
        length_y: size along y [m], a whole number of cells.
        layers: names of the layers.
        state: the state to read; None: that of the maps.

    Raises:
        ValueError, TypeError: for a size that is not a whole number of cells, or a wrong shape, dtype or device. On a
            CPU, or with the map's `check_values`, also for a point that is not finite; elsewhere its submap is unknown.
        KeyError: for an unknown layer.
    """
    grid = emap.cfg.grid
    h, w = (whole_cells(n, length, grid.resolution) for n, length in (("length_x", length_x), ("length_y", length_y)))
    hint = "give names such as ('elevation',)"
    require(not isinstance(layers, str) and len(layers) > 0, "layers", "must be one or more names", repr(layers), hint)
    found = {name: emap.read_layer(name, state) for name in layers}
    first = _find_first_cell(emap, center_xy, (h, w))
    corner = (emap.state if state is None else state).corner
    cell = _number_cells(emap, first - corner, (h, w))
    size = torch.stack([first.new_full((), cells) for cells in (h, w)])
    center = (first.double() + size.double() / 2) * grid.resolution
    return Submap({name: _read_cells(*layer, cell) for name, layer in found.items()}, center, grid.resolution)


def _find_first_cell(emap: ElevationMap, center_xy: object, shape: tuple[int, int]) -> Int[Tensor, "B 2"]:
    """Return the cell of the submap's index [0, 0], counted from the map frame's origin."""
    value, expected = check_tensor("center_xy", center_xy, emap.device, FLOATS), (emap.num_envs, 2)
    actual, hint = tuple(value.shape), "give a point for each environment"
    require(actual == expected, "center_xy", f"expected {expected}", actual, hint)
    if is_readable(value, emap.check_values):
        is_finite = bool(torch.isfinite(value).all())
        require(is_finite, "center_xy", "must be finite", "NaN or inf", "give a point inside the map")
    half = torch.stack([value.new_full((), cells / 2, dtype=torch.float64) for cells in shape])
    cell = torch.floor(value.detach().double() / emap.cfg.grid.resolution - half + 0.5)
    return torch.where(cell.abs() < _MAX_CELL, cell, _MAX_CELL).to(torch.int64)


def _number_cells(emap: ElevationMap, first: Int[Tensor, "B 2"], shape: tuple[int, int]) -> Int[Tensor, "B h w"]:
    """Return the flat index in the map of each cell of the submap; H * W outside the map."""
    grid = emap.cfg.grid
    i, j = (first[:, axis, None] + torch.arange(shape[axis], device=first.device) for axis in (0, 1))
    in_rows, in_columns = (i >= 0) & (i < grid.height), (j >= 0) & (j < grid.width)
    is_inside = in_rows[:, :, None] & in_columns[:, None, :]
    return torch.where(is_inside, i[:, :, None] * grid.width + j[:, None, :], grid.num_cells)


def _read_cells(values: Tensor, known: Tensor, cell: Int[Tensor, "B h w"]) -> Float[Tensor, "B h w"]:
    layer = torch.where(known, values, torch.nan)
    return F.pad(layer.flatten(1), (0, 1), value=torch.nan).gather(1, cell.flatten(1)).view_as(cell)
