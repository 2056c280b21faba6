"""The distance to the ground, and its gradient, at points on and around it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.checks import FLOATS, check_tensor
from torchelev.errors import require, require_positive
from torchelev.filters.geometry import root
from torchelev.filters.registry import check_layers, masked
from torchelev.layers import Layer

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

BLOCK = 2**16  # cells of the grid


@dataclass(frozen=True, kw_only=True)
class FieldConfig:
    """How far around the ground a signed distance field reaches."""

    below: float = 0.2  #: [m] from the lowest known cell down to the lowest level
    height: float = 1.6  #: [m] from the lowest level to the highest
    spacing: float | None = None  #: [m] of the levels; None: the map's resolution
    max_distance: float = 0.5  #: [m] farther points of the grid hold this distance

    def __post_init__(self) -> None:
        require_positive(height=self.height, max_distance=self.max_distance)
        require(self.below >= 0, "below", "must be at least 0", self.below, "give metres, such as 0.2")
        if self.spacing is not None:
            require_positive(spacing=self.spacing)


class FieldSample(NamedTuple):
    """What a field holds at points; 0 where not valid."""

    distance: Float[Tensor, "B M"]  #: [m] positive above the ground
    gradient: Float[Tensor, "B M 3"]  #: of the distance; 1 long but for interpolation, points away from the ground
    valid: Bool[Tensor, "B M"]  #: most of the columns around it are known


@dataclass(frozen=True, eq=False)
class SignedDistanceField:
    """The distance to the ground, and its gradient, for points on and around it.

    Each known cell is a column of ground with a level top, as wide as the cell. On a grid over the cells' centres at K
    levels z, with h_c the height of column c and x_c the horizontal distance from it, 0 within it,

    d = sqrt(min_c (x_c^2 + max(z - h_c, 0)^2)) - sqrt(min_c (x_c^2 + max(h_c - z, 0)^2)):

    from the ground, less that from the air; each counts up to `max_distance`. Heights are not rounded to levels: over
    level ground d = z - h, beside a wall it is the distance to its face. A slope is steps of one cell each, so that d
    comes out short there by at most half a cell times the slope's sine. Unknown cells hold neither ground nor air, and
    beside them d is short by at most half a cell; fill them first where that is wrong. Between the points of the grid
    d is interpolated (trilinear), and `gradient` is the exact derivative of that.

    What grid_map_sdf (Fankhauser & Hutter 2016) and Grandia et al. 2022 keep for planners, in a batch.
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
        """Build the field of heights [m]; `center` [m] is where the window lies, as `ElevationMap.center`.

        `floor` [m] is the height of the lowest level; without it, `cfg.below` under the lowest known cell of each
        map. Differentiable in the heights. Time and memory grow with K H W; time with max_distance / resolution too.
        Raises ValueError for shapes that do not fit and settings out of range.
        """
        require_positive(resolution=resolution)
        cfg = FieldConfig() if cfg is None else cfg
        spacing = resolution if cfg.spacing is None else cfg.spacing
        check_layers("signed distance field", (layer,))
        heights, known = masked(layer)
        B = len(heights)
        center = heights.new_zeros(B, 2) if center is None else center
        fits = center.ndim == 2 and center.shape[0] == B and center.shape[1] >= 2
        require(fits, "center", f"expected ({B}, 2) or ({B}, 3)", tuple(center.shape), "give the map's center")
        if floor is None:
            lowest = torch.where(known, heights.detach(), torch.inf).amin((1, 2))
            floor = torch.where(torch.isfinite(lowest), lowest, 0.0) - cfg.below
        if not isinstance(floor, Tensor):
            number = isinstance(floor, int | float) and math.isfinite(floor)
            require(number, "floor", "must be a number or a tensor", repr(floor), "give metres")
            floor = heights.new_full((B,), float(floor))
        require(floor.shape == (B,), "floor", f"expected ({B},)", tuple(floor.shape), "give one height per map")
        levels = math.ceil(cfg.height / spacing - 1e-6) + 1
        values = _distances(heights - floor[:, None, None], known, levels, spacing / resolution, resolution, cfg)
        return cls(values, known, floor, center[:, :2], resolution, spacing)

    def sample(self, points: Float[Tensor, "B M 3"]) -> FieldSample:
        """Return distance [m] and gradient at points, map frame [m].

        Valid between the lowest and the highest level, inside the window, where at least half of the columns around
        the point are known, by their bilinear weights. Differentiable in the points; the gradient is too. Raises
        TypeError for what is no tensor of floats, ValueError for points of another shape.
        """
        B, K, H, W = self.values.shape
        points = check_tensor("points", points, self.values.device, FLOATS)
        fits = points.ndim == 3 and points.shape[0] == B and points.shape[2] == 3
        require(fits, "points", f"expected ({B}, M, 3)", tuple(points.shape), "give x, y, z in the map frame")
        place, inside = self._place(points)
        # From the outermost centres to the window's rim, distances go on as between the last two centres.
        low = [torch.floor(p.detach()).clamp(0, max(0, n - 2)) for p, n in zip(place, (H, W, K), strict=True)]
        a, b, c = (p - k for p, k in zip(place, low, strict=True))
        i, j, k = (
            torch.stack([k, (k + 1).clamp(max=n - 1)]).to(torch.int64) for k, n in zip(low, (H, W, K), strict=True)
        )
        column = i[:, None] * W + j  # (2, 2, B, M): one step along x, one along y
        corners = _take(self.values, k[:, None, None] * (H * W) + column)  # the same after a step along z
        layers = _between(corners, c)
        rows = _between(layers, a)
        slope_x, slope_y = _between(layers[1] - layers[0], b), rows[1] - rows[0]
        slope_z = _between(_between(corners[1] - corners[0], a), b)
        gradient = torch.stack([slope_x / self.resolution, slope_y / self.resolution, slope_z / self.spacing], -1)
        known = _take(self.known.to(a.dtype), column)
        valid = inside & (_between(_between(known, a), b) >= 0.5)
        return FieldSample(
            torch.where(valid, _between(rows, b), 0.0), torch.where(valid[..., None], gradient, 0.0), valid
        )

    def _place(self, points: Tensor) -> tuple[list[Tensor], Tensor]:
        """Return where points lie, x, y, z (B, M) in steps from the grid's first point, and whether on the grid."""
        _, K, H, W = self.values.shape
        finite = torch.isfinite(points).all(-1)
        x, y, z = torch.where(finite[..., None], points, 0.0).unbind(-1)
        offsets = x - self.center[:, :1], y - self.center[:, 1:], z - self.floor[:, None]
        steps = (self.resolution, self.resolution, self.spacing)
        firsts, sizes = (H / 2 - 0.5, W / 2 - 0.5, 0.0), (H, W, K)
        place = [o.to(self.values.dtype) / s + first for o, s, first in zip(offsets, steps, firsts, strict=True)]
        beyond = (0.5, 0.5, 0.0)
        on = [(p >= -rim) & (p <= n - 1 + rim) for p, n, rim in zip(place, sizes, beyond, strict=True)]
        return [p.clamp(-1, n) for p, n in zip(place, sizes, strict=True)], finite & on[0] & on[1] & on[2]


def _take(values: Tensor, index: Tensor) -> Tensor:
    """Take from values (B, ...) by flat numbers (..., B, M)."""
    numbers = index.flatten(0, -3).transpose(0, 1)  # (B, P, M)
    taken = values.flatten(1).gather(1, numbers.flatten(1)).view(numbers.shape)
    return taken.transpose(0, 1).reshape(index.shape)


def _between(ends: Tensor, part: Tensor) -> Tensor:
    """Interpolate between the two ends that the first dimension holds."""
    return ends[0] + part * (ends[1] - ends[0])


def _distances(
    heights: Tensor, known: Tensor, levels: int, spacing: float, resolution: float, cfg: FieldConfig
) -> Float[Tensor, "B K H W"]:
    """Return the signed distances [m] on the grid, from heights [m] over the lowest level and the spacing [cells]."""
    B, H, W = heights.shape
    reach = cfg.max_distance / resolution  # [cells], as all that follows
    level = torch.arange(levels, device=heights.device, dtype=heights.dtype).view(-1, 1, 1) * spacing
    above = level - heights[:, None] / resolution
    weight = known.to(heights.dtype)[:, None]
    if heights.device.type != "cpu" or B == 0:
        return _from_columns(above, weight, reach) * resolution
    # Some levels at a time, which stay in a core's cache: half the time for a map of 200 x 200 cells.
    some = max(1, BLOCK // (H * W))
    maps = zip(above, weight, strict=True)
    fields = [torch.cat([_from_columns(part, mask, reach) for part in one.split(some)]) for one, mask in maps]
    return torch.stack(fields) * resolution


def _from_columns(above: Tensor, weight: Tensor, reach: float) -> Tensor:
    """Return the signed distances from how far (..., H, W) lies above its column, of weight 0 where unknown."""
    blank = (reach + 1) ** 2
    squared = torch.stack([above, -above]).clamp(min=0).square() + (1 - weight) * blank
    for dim in (-2, -1):
        squared = _least(squared, reach, dim, blank)
    to_ground, to_air = root(squared.clamp(max=reach**2)).unbind(0)
    return to_ground - to_air


def _least(squared: Tensor, reach: float, dim: int, blank: float) -> Tensor:
    """Return min_k (squared[k cells on] + max(|k| - 1/2, 0)^2) along a dimension, exact up to reach^2."""
    size = squared.shape[dim]
    rim = min(math.ceil(reach + 0.5), size - 1)
    rimmed = F.pad(squared, [rim, rim] if dim == -1 else [0, 0, rim, rim], value=blank)
    least = squared
    for k in range(1, rim + 1):
        there = torch.minimum(rimmed.narrow(dim, rim - k, size), rimmed.narrow(dim, rim + k, size))
        least = torch.minimum(least, there + (k - 0.5) ** 2)
    return least
