"""The signed distance to the ground in space, and its gradient."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import require, require_positive
from torchelev.filters.distances.column_distance import column_distances
from torchelev.filters.layer_tools import check_layers, zero_unknown
from torchelev.inputs.checks import FLOATS, check_tensor
from torchelev.layers import Layer

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


@dataclass(frozen=True, kw_only=True)
class FieldConfig:
    """How far around the ground a signed distance field extends."""

    below: float = 0.2  #: [m] from the lowest known cell down to the lowest level
    height: float = 1.6  #: [m] from the lowest level to the highest; cover the robot's body
    spacing: float | None = None  #: [m] between levels; None: the map's resolution
    max_distance: float = 0.5  #: [m] larger distances are cut to it; time grows with it

    def __post_init__(self) -> None:
        require_positive(height=self.height, max_distance=self.max_distance)
        require(self.below >= 0, "below", "must be at least 0", self.below, "give metres, such as 0.2")
        if self.spacing is not None:
            require_positive(spacing=self.spacing)


class FieldSample(NamedTuple):
    """A field's values at points; 0 where not valid."""

    distance: Float[Tensor, "B M"]  #: [m] positive above the ground
    gradient: Float[Tensor, "B M 3"]  #: of the distance, away from the ground; about 1 long, apart from interpolation
    valid: Bool[Tensor, "B M"]  #: the point lies in the field, and at least half of the columns around it are known


@dataclass(frozen=True, eq=False)
class SignedDistanceField:
    """The signed distance to the ground, and its gradient, at points around it.

    Each known cell is a column of ground with a level top, as wide as the cell. At the cells' centres and at K levels
    z, with h_c the height of column c and x_c the horizontal distance from it (0 inside),

    d = sqrt(min_c (x_c^2 + max(z - h_c, 0)^2)) - sqrt(min_c (x_c^2 + max(h_c - z, 0)^2)):

    the distance to the ground minus that to the air, each cut to `max_distance`. Heights are not rounded to levels:
    over level ground d = z - h, and beside a wall d is the distance to its face. A slope is a staircase of cells, where
    d is short by at most half a cell times the slope's sine. Unknown cells hold neither ground nor air; next to them d
    is short by at most half a cell, so in-paint them where that matters. Between grid points d is interpolated
    (trilinear), and `gradient` is the exact derivative of the interpolation.

    The batched counterpart of grid_map_sdf (Fankhauser & Hutter 2016) and of the field in Grandia et al. 2022.
    """

    values: Float[Tensor, "B K H W"]  #: [m]
    known: Bool[Tensor, "B H W"]  #: the column has a known height
    floor: Float[Tensor, "B"]  #: [m] height of the lowest level, map frame
    center: Float[Tensor, "B 2"]  #: [m] of the window, map frame
    resolution: float  #: [m] of the cells
    spacing: float  #: [m] between the levels

    @classmethod
    def from_layer(
        cls,
        layer: Layer,
        *,
        resolution: float,
        center: Float[Tensor, "B 3"] | None = None,
        floor: float | Float[Tensor, "B"] | None = None,
        cfg: FieldConfig | None = None,
    ) -> SignedDistanceField:
        """Build the field of a layer of heights.

        Differentiable in the heights. Time and memory grow with K H W, time also with max_distance / resolution.

        Args:
            layer: heights [m] and mask (B, H, W).
            resolution: [m] of a cell.
            center: (B, 2) or (B, 3) [m] of the windows, such as `ElevationMap.center`; default: 0.
            floor: [m] of the lowest level; default: `cfg.below` under the lowest known cell of each map.
            cfg: the field's extent.

        Raises:
            TypeError: if the layer is not a pair of tensors.
            ValueError: if shapes do not fit, or a setting is out of range.
        """
        require_positive(resolution=resolution)
        cfg = FieldConfig() if cfg is None else cfg
        spacing = resolution if cfg.spacing is None else cfg.spacing
        check_layers("signed distance field", (layer,))
        heights, known = zero_unknown(layer)
        B = len(heights)
        center = heights.new_zeros(B, 2) if center is None else center
        fits = center.ndim == 2 and center.shape[0] == B and center.shape[1] >= 2
        require(fits, "center", f"expected ({B}, 2) or ({B}, 3)", tuple(center.shape), "give the map's center")
        if floor is None:
            lowest = torch.where(known, heights.detach(), torch.inf).amin((1, 2))
            floor = torch.where(torch.isfinite(lowest), lowest, 0.0) - cfg.below
        if not isinstance(floor, Tensor):
            is_number = isinstance(floor, int | float) and math.isfinite(floor)
            require(is_number, "floor", "must be a number or a tensor", repr(floor), "give metres")
            floor = heights.new_full((B,), float(floor))
        require(floor.shape == (B,), "floor", f"expected ({B},)", tuple(floor.shape), "give one height per map")
        num_levels = math.ceil(cfg.height / spacing - 1e-6) + 1
        cells = (heights - floor[:, None, None]) / resolution
        values = column_distances(cells, known, num_levels, spacing / resolution, cfg.max_distance / resolution)
        return cls(values * resolution, known, floor, center[:, :2], resolution, spacing)

    def sample(self, points: Float[Tensor, "B M 3"]) -> FieldSample:
        """Return distance [m] and gradient at points.

        Differentiable in the points; so is the gradient.

        Args:
            points: (B, M, 3) [m], map frame.

        Returns:
            Distances, gradients and where they are valid: between the lowest and the highest level, inside the window,
            where known columns have at least half of the bilinear weight.

        Raises:
            TypeError: if the points are not a tensor of floats.
            ValueError: if they have another shape.
        """
        B, K, H, W = self.values.shape
        points = check_tensor("points", points, self.values.device, FLOATS)
        fits = points.ndim == 3 and points.shape[0] == B and points.shape[2] == 3
        require(fits, "points", f"expected ({B}, M, 3)", tuple(points.shape), "give x, y, z in the map frame")
        position, is_inside = self._grid_position(points)
        # Between the outermost centres and the window's rim, distances are extrapolated from the last two centres.
        low = [torch.floor(p.detach()).clamp(0, max(0, n - 2)) for p, n in zip(position, (H, W, K), strict=True)]
        a, b, c = (p - k for p, k in zip(position, low, strict=True))
        i, j, k = (
            torch.stack([k, (k + 1).clamp(max=n - 1)]).to(torch.int64) for k, n in zip(low, (H, W, K), strict=True)
        )
        column = i[:, None] * W + j  # (2, 2, B, M): one step along x, one along y
        corners = _take(self.values, k[:, None, None] * (H * W) + column)  # (2, 2, 2, B, M): along z first
        layers = _interpolate(corners, c)
        rows = _interpolate(layers, a)
        slope_x, slope_y = _interpolate(layers[1] - layers[0], b), rows[1] - rows[0]
        slope_z = _interpolate(_interpolate(corners[1] - corners[0], a), b)
        gradient = torch.stack([slope_x / self.resolution, slope_y / self.resolution, slope_z / self.spacing], -1)
        known = _take(self.known.to(a.dtype), column)
        valid = is_inside & (_interpolate(_interpolate(known, a), b) >= 0.5)
        distance = torch.where(valid, _interpolate(rows, b), 0.0)
        return FieldSample(distance, torch.where(valid[..., None], gradient, 0.0), valid)

    def _grid_position(self, points: Tensor) -> tuple[list[Tensor], Tensor]:
        """Return x, y, z (B, M) of points in steps from the first grid point, and which lie inside the field."""
        _, K, H, W = self.values.shape
        is_finite = torch.isfinite(points).all(-1)
        x, y, z = torch.where(is_finite[..., None], points, 0.0).unbind(-1)
        offsets = x - self.center[:, :1], y - self.center[:, 1:], z - self.floor[:, None]
        steps = (self.resolution, self.resolution, self.spacing)
        firsts, sizes = (H / 2 - 0.5, W / 2 - 0.5, 0.0), (H, W, K)
        position = [o.to(self.values.dtype) / s + first for o, s, first in zip(offsets, steps, firsts, strict=True)]
        margins = (0.5, 0.5, 0.0)
        inside = [(p >= -rim) & (p <= n - 1 + rim) for p, n, rim in zip(position, sizes, margins, strict=True)]
        position = [p.clamp(-1, n) for p, n in zip(position, sizes, strict=True)]
        return position, is_finite & inside[0] & inside[1] & inside[2]


def _take(values: Tensor, index: Tensor) -> Tensor:
    """Gather from values (B, ...) by flat indices (..., B, M)."""
    flat = index.flatten(0, -3).transpose(0, 1)  # (B, P, M)
    taken = values.flatten(1).gather(1, flat.flatten(1)).view(flat.shape)
    return taken.transpose(0, 1).reshape(index.shape)


def _interpolate(ends: Tensor, fraction: Tensor) -> Tensor:
    """Interpolate linearly between ends[0] and ends[1]."""
    return ends[0] + fraction * (ends[1] - ends[0])
