"""Read layers at points, and fill heights where the map is unknown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.errors import message, require
from torchelev.grid import GridConfig
from torchelev.layers import Layer, sample_layers
from torchelev.maps.readable import ReadableMap
from torchelev.observations.ground import border_left_out, continue_ground
from torchelev.ops.windows import padded, window_moments
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

MODES = ("bilinear", "nearest", "minimum")
FILLS = ("ground", "base", "lowest", "upper_bound", "inpaint")
ORIGINAL = "original"


class Query(NamedTuple):
    """The points at which an observation reads the maps."""

    uv: Float[Tensor, "B M 2"]  #: points, in cells from the window's corner
    base_uv: Float[Tensor, "B 1 2"]  #: the base, in cells from the window's corner
    base_z: Float[Tensor, "B 1"]  #: [m] height of the base, map frame
    half_extent: tuple[int, int]  #: [cells] largest distance of points from the window's centre along x and y
    grid: GridConfig  #: the maps' grid


def require_mode(mode: object) -> None:
    """Refuse an unknown mode of reading."""
    require(mode in MODES, "mode", f"must be one of {', '.join(MODES)}", repr(mode), "use bilinear")


def require_fill(name: str, fill: object, names: Sequence[str], clip: float | None) -> None:
    """Refuse a fill that is neither one of `names` nor a number; inf needs a clip."""
    is_number = isinstance(fill, int | float) and not isinstance(fill, bool)
    is_name = isinstance(fill, str) and fill in names
    if not (is_number or is_name):
        from difflib import get_close_matches  # which only this error needs

        hint = f"use {next(iter(get_close_matches(str(fill), names, 1)), 'ground')}"
        raise ValueError(message(name, f"must be a number or one of {', '.join(names)}", repr(fill), hint))
    if isinstance(fill, int | float):
        is_bounded = math.isfinite(fill) or (clip is not None and not math.isnan(fill))
        require(is_bounded, name, "must be finite without a clip", fill, "give metres, or clip")


def read_points(layers: Sequence[Layer], uv: Float[Tensor, "B M 2"], grid: GridConfig, mode: str) -> list[Layer]:
    """Read layers at points.

    "bilinear" and "nearest" are those of `ElevationMap.sample`. "minimum" is the lowest known one of three cells: the
    one whose centre precedes the point along x and y, the next one along x, and the next one along y. legged_gym reads
    the vertices of its height field that way.

    Args:
        layers: values, and where they are known, (B, H, W).
        uv: the points, in cells from the window's corner.
        grid: the maps' grid.
        mode: one of MODES.

    Returns:
        For each layer its values (B, M), 0 where not known, and where they are known.
    """
    if mode != "minimum":
        return sample_layers(layers, uv, grid, mode)
    preceding = uv - 0.5
    one, zero = torch.ones_like(uv[..., :1]), torch.zeros_like(uv[..., :1])
    corners = [preceding, preceding + torch.cat([one, zero], -1), preceding + torch.cat([zero, one], -1)]
    read = sample_layers(layers, torch.cat(corners, 1), grid, "nearest")
    return [_find_lowest(values.unflatten(1, (3, -1)), known.unflatten(1, (3, -1)), dim=1) for values, known in read]


def filled_layers(
    fill: str | float, emap: ReadableMap, state: MapState | None, half_extent: tuple[int, int], rings: int
) -> list[Layer]:
    """Return the layer that fills unknown heights, to be read at the same points; none for the other rules.

    Args:
        fill: one of FILLS, or a number.
        emap: the maps.
        state: the state to read; None: that of the maps.
        half_extent: as in `Query`.
        rings: how far "inpaint" reaches [cells].
    """
    if fill == "upper_bound":
        return [emap.read_layer(fill, state)]
    return [inpaint(emap.read_layer("elevation", state), half_extent, rings)] if fill == "inpaint" else []


def fill_unknown(fill: str | float, state: MapState, query: Query, read: Layer, filled: Sequence[Layer]) -> Layer:
    """Fill the unknown ones of the heights read at points by a rule.

    Args:
        fill: one of FILLS, or a number. "base" and numbers fill in no heights.
        state: the state of the maps.
        query: the points.
        read: the elevation (B, M) at the points, and where it is known.
        filled: what was read there of `filled_layers`.

    Returns:
        Heights (B, M), and where the map or the rule provides one.
    """
    elevation, known = read
    if fill == "ground":
        layer = (state.elevation, state.validity)
        ground, found = continue_ground(layer, query.uv, query.base_uv, query.base_z, query.grid, query.half_extent)
    elif fill == "lowest":
        ground, found = (part[:, None] for part in _find_lowest(elevation, known, dim=1))
    elif filled:
        ((ground, found),) = filled
    else:
        return elevation, known
    return torch.where(known, elevation, ground), known | found


def _find_lowest(heights: Float[Tensor, "B *M"], known: Bool[Tensor, "B *M"], dim: int) -> Layer:
    """Return the lowest known height along a dimension, 0 if there is none, and whether there is one."""
    low = torch.where(known, heights, torch.inf).amin(dim)
    found = torch.isfinite(low)
    return torch.where(found, low, 0.0), found


def inpaint(layer: Layer, half_extent: tuple[int, int], rings: int) -> Layer:
    """Fill unknown cells with the mean of their known neighbours among eight, one ring of cells after the other.

    Only cells within `half_extent` + `rings` cells of the window's centre along x and y are read; the others are
    unknown in the result.
    """
    values, known = layer
    H, W = values.shape[1:]
    top, left = border_left_out((H, W), half_extent, rings)
    part = known[:, top : H - top, left : W - left]
    heights = torch.where(part, values[:, top : H - top, left : W - left], 0.0)
    weighted = torch.stack([heights, part.to(values.dtype)], 1)  # height and weight, 0 or 1
    for _ in range(rings):
        (sums,) = window_moments([(padded(weighted, 1, 0.0), 0)], 1, 1)  # on a CPU, a twelfth of pooling's time
        weighted = torch.where(weighted[:, 1:] > 0, weighted, sums / sums[:, 1:].clamp(min=1))
    heights, weight = weighted.unbind(1)
    rim = [left, left, top, top]
    return F.pad(heights, rim), F.pad(weight, rim) > 0
