"""Segmentation of maps into planar regions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchelev.errors import require, require_positive
from torchelev.ops.parallel import map_in_order
from torchelev.planes.assemble import MapFrames, assemble_maps
from torchelev.planes.grow import drop_distant, grow, relabel_components, smooth_borders
from torchelev.planes.lattice import components
from torchelev.planes.local_planes import Limits, fit_local_planes, window_radius
from torchelev.planes.merge import merge
from torchelev.planes.region_planes import RegionPlanes, fit_planes
from torchelev.planes.regions import Planes
from torchelev.planes.split import split
from torchelev.planes.sums import Surface, find_runs, make_surface, pad_cells, region_moments

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy import ndarray


_MAX_HEIGHT = 1e5  # [m] heights beyond it are unknown
_CELLS_AT_A_TIME = 2**17  # of several maps: fewer cost Python more, and more no longer fit the caches


@dataclass(frozen=True, kw_only=True)
class PlaneConfig:
    """Thresholds of a planar region."""

    window: float = 0.2  #: [m] side of the square around a cell that makes its local plane; at least 3 cells
    max_inclination: float = 0.6  #: [rad] of local planes and of regions
    max_roughness: float = 0.01  #: [m] root mean square distance of cells from their plane; keep it above the noise
    max_distance: float = 0.025  #: [m] of any cell from its region's plane
    max_curvature: float = 2.0  #: [1/m] change of slope between neighbouring cells; lower it to cut at softer edges
    min_area: float = 0.04  #: [m^2] projected onto x and y; smaller regions are dropped
    margin: float = 0.03  #: [m] between the inset and the region's border; raise it for large feet

    def __post_init__(self) -> None:
        for name in ("window", "max_roughness", "max_distance", "max_curvature"):
            require_positive(**{f"planes.{name}": getattr(self, name)})
        for name in ("min_area", "margin"):
            value = getattr(self, name)
            is_valid = isinstance(value, int | float) and 0 <= value < math.inf
            require(is_valid, f"planes.{name}", "must not be negative", value, "give 0 for none")
        is_valid, rule = 0 < self.max_inclination < math.pi / 2, "must lie in (0, pi / 2) rad"
        require(is_valid, "planes.max_inclination", rule, self.max_inclination, "see its default")

    @property
    def limits(self) -> Limits:
        """The limits of a plane."""
        return Limits(math.tan(self.max_inclination), self.max_roughness, self.max_distance, self.max_curvature)


def segment(
    elevation: Float[Tensor, "B H W"] | Float[Tensor, "H W"],
    resolution: float,
    cfg: PlaneConfig | None = None,
    center: Any = None,
) -> list[Planes]:
    """Segment maps into planar regions with their polygons.

    1. Fit a plane to the window around each cell. The cell is planar if that is neither too steep nor too rough.
    2. Connect neighbouring planar cells that agree in height and slope.
    3. Cut components that are not planar until they are, by gradients or heights, without randomness.
    4. Grow regions back onto cells whose windows reached over an edge, each cell to the nearest plane, and merge
       neighbours that lie on one plane.
    5. Fit a plane by least squares to the cells of each region that is large enough, and trace its polygons.

    Step 1 and the comparisons of step 2 run on the tensor's device, the rest on the host. Needs OpenCV.

    Args:
        elevation: [m] absolute heights; NaN, infinite values and heights beyond 100 km are unknown.
        resolution: [m] of a cell.
        cfg: what counts as a region.
        center: [m] x and y of the maps' centres in the map frame: (2,) or (3,) for all maps, or (B, 2) or (B, 3), such
            as `ElevationMap.center`; default: 0.

    Returns:
        One `Planes` per map; a list of one for a single map (H, W).

    Raises:
        TypeError: if the elevation is not a tensor of floats, or `cfg` is not a `PlaneConfig`.
        ValueError: if a shape or value does not fit.
    """
    cfg = PlaneConfig() if cfg is None else cfg
    require(isinstance(cfg, PlaneConfig), "cfg", "must be a PlaneConfig", repr(cfg), "build one", TypeError)
    _check(elevation, resolution)
    heights = elevation.detach().to(torch.float64).reshape(-1, *elevation.shape[-2:])
    B, H, W = heights.shape
    corners = _centers(center, B) - np.array([H, W]) * resolution / 2
    at_a_time = max(1, _CELLS_AT_A_TIME // (H * W))
    layers = None if heights.is_cpu else _fit_on_device(heights, resolution, cfg)  # all maps at once

    def segment_from(first: int) -> list[Planes]:
        part = slice(first, first + at_a_time)
        maps = _HostMaps(*(v[part] for v in layers)) if layers else _fit_on_device(heights[part], resolution, cfg)
        return _segment_maps(maps, resolution, corners[part], cfg)

    starts = range(0, B, at_a_time)
    # A single piece leaves the threads to its operations.
    found = map(segment_from, starts) if len(starts) == 1 else map_in_order(segment_from, starts)
    return [planes for part in found for planes in part]


def _check(elevation: Tensor, resolution: float) -> None:
    is_float = isinstance(elevation, Tensor) and elevation.is_floating_point()
    actual = getattr(elevation, "dtype", type(elevation).__name__)
    require(is_float, "elevation", "must be a tensor of floats", actual, "give torch.as_tensor(...)", TypeError)
    fits = elevation.ndim in (2, 3) and min(elevation.shape[-2:]) > 0
    require(fits, "elevation", "must be (B, H, W) or (H, W)", tuple(elevation.shape), "give one cell at least")
    require_positive(resolution=resolution)


def _centers(center: Any, number: int) -> Float[ndarray, "B 2"]:
    """Return x and y of each map's centre."""
    values = center.detach().cpu().numpy() if isinstance(center, Tensor) else center
    values = np.zeros(2) if values is None else np.asarray(values, np.float64)
    fits = values.shape in [(n, d)[k:] for n in (number,) for d in (2, 3) for k in (0, 1)]
    rule = f"must be (2,), (3,), ({number}, 2) or ({number}, 3)"
    require(fits, "center", rule, values.shape, "give x and y [m] of the map's centre")
    require(bool(np.isfinite(values).all()), "center", "must be finite", "NaN or inf", "give metres")
    return np.broadcast_to(values[..., :2], (number, 2))


class _HostMaps(NamedTuple):
    """Maps and their `LocalPlanes` on the host."""

    known: Bool[ndarray, "B H W"]
    height: Float[ndarray, "B H W"]
    gradient_x: Float[ndarray, "B H W"]
    gradient_y: Float[ndarray, "B H W"]
    is_planar: Bool[ndarray, "B H W"]
    is_joined_x: Bool[ndarray, "B H-1 W"]
    is_joined_y: Bool[ndarray, "B H W-1"]


def _fit_on_device(heights: Float[Tensor, "B H W"], resolution: float, cfg: PlaneConfig) -> _HostMaps:
    """Fit the local planes of maps on their device: steps 1 and 2."""
    known = heights.abs() < _MAX_HEIGHT
    local = fit_local_planes(heights, known, resolution, window_radius(cfg.window, resolution), cfg.limits)
    return _HostMaps(*(values.cpu().numpy() for values in (known, heights, *local)))


def _segment_maps(maps: _HostMaps, resolution: float, corner: Float[ndarray, "B 2"], cfg: PlaneConfig) -> list[Planes]:
    """Segment maps, given their local planes, in one go: steps 2 to 5."""
    known, height = maps.known, maps.height
    labels, number = components(*(_stack(values, known.shape[1] + 1) for values in maps[4:]))
    if number == 0:
        return [Planes(np.full(known.shape[1:], -1, np.int32), ()) for _ in known]
    datum = np.array([z[k].mean() if k.any() else 0.0 for z, k in zip(height, known, strict=True)])
    above, radius = height - datum[:, None, None], window_radius(cfg.window, resolution)
    surface = make_surface(known, above, maps.gradient_x, maps.gradient_y, resolution, radius)
    found, plane = _find_regions(pad_cells(labels, -1).ravel(), surface, cfg)
    return assemble_maps(found, plane, surface, MapFrames(resolution, corner, datum, known.shape[1] + 1), cfg.margin)


def _stack(values: Bool[ndarray, "B H W"], rows: int) -> Bool[ndarray, "R W"]:
    """Lay out maps one below the other, `rows` apart; what lies between them is False."""
    B, H, W = values.shape
    stacked = np.zeros((B, rows, W), bool)
    stacked[:, :H] = values
    return stacked.reshape(B * rows, W)[: H - rows]


def _find_regions(
    labels: Int[ndarray, "P"], surface: Surface, cfg: PlaneConfig
) -> tuple[Int[ndarray, "P"], RegionPlanes]:
    """Turn components into planar regions: steps 3 to 5, without the polygons."""
    labels, plane = split(labels, surface, cfg.limits)
    labels = grow(labels, plane, surface, cfg.max_distance, surface.radius, may_take_over=True)
    labels = smooth_borders(labels, plane, surface, cfg.max_distance)
    labels = merge(labels, surface, cfg.max_roughness, len(plane.number))
    labels = drop_distant(labels, _refit(labels, plane, surface), surface, cfg.max_distance)
    labels, previous = relabel_components(labels, surface.shape, cfg.min_area / surface.resolution**2)
    plane = _refit(labels, plane.select(previous), surface)
    labels = grow(labels, plane, surface, cfg.max_distance, surface.radius, may_take_over=False)
    plane = _refit(labels, plane, surface)
    keep = plane.gradient_x**2 + plane.gradient_y**2 <= cfg.limits.slope**2
    rank = np.append(np.where(keep, np.cumsum(keep) - 1, -1), -1)  # the last entry is for label -1
    return rank[labels], plane.select(keep)


def _refit(labels: Int[ndarray, "P"], before: RegionPlanes, surface: Surface) -> RegionPlanes:
    """Fit planes to changed regions. Their old gradients are the prior: windows of new cells may cross an edge."""
    moments = region_moments(surface, find_runs(labels), len(before.number))
    return fit_planes(moments, (before.gradient_x, before.gradient_y), surface.window_moment)
