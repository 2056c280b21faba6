"""Segment maps into planar regions, with their polygons: where feet can stand, for planners and controllers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchelev.errors import require, require_positive
from torchelev.planes.fits import Limits, local_planes, window_radius
from torchelev.planes.grow import connected, grow, merge, near, settle
from torchelev.planes.lattice import Outlines, borders, components, insets, interior
from torchelev.planes.regions import Planes, Region
from torchelev.planes.split import split
from torchelev.planes.sums import RegionPlanes, Surface, find_runs, fit_planes, make_surface, region_moments, rimmed

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy import ndarray


HIGHEST = 1e5  # [m] heights beyond count as unknown


@dataclass(frozen=True, kw_only=True)
class PlaneConfig:
    """What counts as a planar region."""

    window: float = 0.2  #: [m] the side of the square whose cells make a cell's local plane; 3 cells at least
    max_inclination: float = 0.6  #: [rad] of local planes and of regions
    max_roughness: float = 0.01  #: [m] root mean square distance of the cells from their plane, more than the noise
    max_distance: float = 0.025  #: [m] of any cell from its region's plane
    max_curvature: float = 2.0  #: [1/m] change of slope between neighbouring cells of a region, where it begins
    min_area: float = 0.04  #: [m^2] projected onto x and y
    margin: float = 0.03  #: [m] that the inset keeps from the region's border

    def __post_init__(self) -> None:
        for name in ("window", "max_roughness", "max_distance", "max_curvature"):
            require_positive(**{f"planes.{name}": getattr(self, name)})
        for name in ("min_area", "margin"):
            value = getattr(self, name)
            number = isinstance(value, int | float) and 0 <= value < math.inf
            require(number, f"planes.{name}", "must not be negative", value, "give 0 for none")
        sloped = 0 < self.max_inclination < math.pi / 2
        require(
            sloped, "planes.max_inclination", "must lie in (0, pi / 2) rad", self.max_inclination, "see its default"
        )

    @property
    def limits(self) -> Limits:
        """The limits of planes."""
        return Limits(math.tan(self.max_inclination), self.max_roughness, self.max_distance, self.max_curvature)


class HostMap(NamedTuple):
    """One map and its local planes on the host, as of `LocalPlanes`."""

    known: Bool[ndarray, "H W"]  #: the cell has a height
    height: Float[ndarray, "H W"]  #: [m]
    gradient_x: Float[ndarray, "H W"]  #: dz/dx
    gradient_y: Float[ndarray, "H W"]  #: dz/dy
    planar: Bool[ndarray, "H W"]  #: the cell lies on its local plane
    joined_x: Bool[ndarray, "H-1 W"]  #: the cell and its neighbour along x lie on one surface
    joined_y: Bool[ndarray, "H W-1"]  #: the cell and its neighbour along y lie on one surface


class GridFrame(NamedTuple):
    """Where the cells of one map lie."""

    resolution: float  #: [m]
    corner: Float[ndarray, "2"]  #: [m] the lowest x and y of the map

    def xy(self, cell: ndarray) -> Float[ndarray, "... 2"]:
        """Return x and y [m] of places given in cells from the corner."""
        return self.corner + cell * self.resolution


def segment(
    elevation: Float[Tensor, "B H W"] | Float[Tensor, "H W"],
    resolution: float,
    cfg: PlaneConfig | None = None,
    center: Any = None,
) -> list[Planes]:
    """Segment maps into planar regions: one `Planes` for each map, also where one map (H, W) is given.

    `elevation` [m], absolute; NaN, inf and what lies beyond 100 km are unknown. `resolution` [m] of a cell. `center`
    [m], (2,) or (3,) for all maps or (B, 2) or (B, 3): the map frame's x and y of the maps' middle, zero by default.

    1. A plane is fitted to the window around each cell; a cell is planar where that is neither too steep nor too rough.
    2. Planar cells that are neighbours and agree in height and slope make components.
    3. Components that are not planar are cut until they are, by gradients or heights, without any randomness.
    4. Regions grow back onto cells whose windows reached over an edge, each cell to the nearest plane.
    5. Regions large enough get a plane by least squares over their cells, and their polygons.

    Steps 1 and 2 run on the tensors' device for all maps at once, the others map by map on the host, with OpenCV.
    Raises TypeError or ValueError for inputs that do not fit.
    """
    cfg = PlaneConfig() if cfg is None else cfg
    require(isinstance(cfg, PlaneConfig), "cfg", "must be a PlaneConfig", repr(cfg), "build one", TypeError)
    _check(elevation, resolution)
    heights = elevation.detach().to(torch.float64).reshape(-1, *elevation.shape[-2:])
    middles = _middles(center, len(heights))
    known = heights.abs() < HIGHEST
    radius = window_radius(cfg.window, resolution)
    local = local_planes(heights, known, resolution, radius, cfg.limits)
    host = [values.cpu().numpy() for values in (known, heights, *local)]
    corners = middles - np.array(heights.shape[1:]) * resolution / 2
    return [
        _segment(HostMap(*layers), radius, GridFrame(resolution, corner), cfg)
        for *layers, corner in zip(*host, corners, strict=True)
    ]


def _check(elevation: Tensor, resolution: float) -> None:
    tensor = isinstance(elevation, Tensor) and elevation.is_floating_point()
    actual = getattr(elevation, "dtype", type(elevation).__name__)
    require(tensor, "elevation", "must be a tensor of floats", actual, "give torch.as_tensor(...)", TypeError)
    fits = elevation.ndim in (2, 3) and min(elevation.shape[-2:]) > 0
    require(fits, "elevation", "must be (B, H, W) or (H, W)", tuple(elevation.shape), "give one cell at least")
    require_positive(resolution=resolution)


def _middles(center: Any, number: int) -> Float[ndarray, "B 2"]:
    """Return x and y of each map's middle."""
    values = center.detach().cpu().numpy() if isinstance(center, Tensor) else center
    values = np.zeros(2) if values is None else np.asarray(values, np.float64)
    fits = values.shape in [(n, d)[k:] for n in (number,) for d in (2, 3) for k in (0, 1)]
    rule = f"must be (2,), (3,), ({number}, 2) or ({number}, 3)"
    require(fits, "center", rule, values.shape, "give x and y [m] of the map's middle")
    require(bool(np.isfinite(values).all()), "center", "must be finite", "NaN or inf", "give metres")
    return np.broadcast_to(values[..., :2], (number, 2))


def _segment(one: HostMap, radius: int, frame: GridFrame, cfg: PlaneConfig) -> Planes:
    """Segment one map."""
    labels, number = components(one.planar, one.joined_x, one.joined_y)
    if number == 0:
        return Planes(labels, ())
    datum = one.height[one.known].mean()
    surface = make_surface(one.known, one.height - datum, one.gradient_x, one.gradient_y, frame.resolution, radius)
    flat, plane = _regions(rimmed(labels, -1).ravel(), surface, cfg)
    labels = flat.reshape(len(labels) + 1, -1)[:-1, :-1].astype(np.int32)
    x, y = frame.xy(np.array(labels.shape) / 2)
    plane = plane._replace(x0=plane.x0 + x, y0=plane.y0 + y, z0=plane.z0 + datum)
    return Planes(labels, _assemble(labels, plane, frame, cfg))


def _regions(labels: Int[ndarray, "P"], surface: Surface, cfg: PlaneConfig) -> tuple[Int[ndarray, "P"], RegionPlanes]:
    """Turn components into planar regions: steps 3 to 5."""
    labels, plane = split(labels, surface, cfg.limits)
    labels = grow(labels, plane, surface, cfg.max_distance, surface.radius, contested=True)
    labels = settle(labels, plane, surface, cfg.max_distance)
    labels = merge(labels, surface, cfg.max_roughness, len(plane.number))
    labels = near(labels, _fit(labels, plane, surface), surface, cfg.max_distance)
    labels, was = connected(labels, surface.shape, cfg.min_area / surface.resolution**2)
    plane = _fit(labels, plane.at(was), surface)
    labels = grow(labels, plane, surface, cfg.max_distance, surface.radius, contested=False)
    plane = _fit(labels, plane, surface)
    keep = plane.gradient_x**2 + plane.gradient_y**2 <= cfg.limits.slope**2
    rank = np.append(np.where(keep, np.cumsum(keep) - 1, -1), -1)  # the last is that of label -1
    return rank[labels], plane.at(keep)


def _fit(labels: Int[ndarray, "P"], before: RegionPlanes, surface: Surface) -> RegionPlanes:
    """Fit the planes anew after regions changed; windows of cells that joined later may reach over an edge."""
    moments = region_moments(surface, find_runs(labels), len(before.number))
    return fit_planes(moments, (before.gradient_x, before.gradient_y), surface.weight)


def _assemble(
    labels: Int[ndarray, "H W"], plane: RegionPlanes, frame: GridFrame, cfg: PlaneConfig
) -> tuple[Region, ...]:
    """Trace the regions and put their polygons onto their planes."""
    if len(plane.number) == 0:
        return ()
    inside = interior(labels)
    outer, holes = _polygons(borders(inside, labels), plane, frame)
    inner, inner_holes = _polygons(insets(inside, labels, cfg.margin / frame.resolution), plane, frame)
    normal = np.column_stack([-plane.gradient_x, -plane.gradient_y, np.ones(len(plane.number))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    point = np.column_stack([plane.x0, plane.y0, plane.z0])
    area = plane.number * frame.resolution**2
    return tuple(
        Region(k, normal[k], point[k], outer[k][0], holes[k], inner[k], inner_holes[k], area[k], plane.roughness[k])
        for k in range(len(area))
    )


def _polygons(
    outlines: Outlines, plane: RegionPlanes, frame: GridFrame
) -> tuple[list[list[ndarray]], list[list[ndarray]]]:
    """Return for each region the polygons that surround its ground, and those that leave some out."""
    label = np.repeat(outlines.label, outlines.length)
    xy = frame.xy(outlines.points / 2)
    z = plane.z0[label] + plane.gradient_x[label] * (xy[:, 0] - plane.x0[label])
    z += plane.gradient_y[label] * (xy[:, 1] - plane.y0[label])
    each = np.split(np.column_stack([xy, z]), np.cumsum(outlines.length))[:-1]  # the last is what follows
    around: list[list[ndarray]] = [[] for _ in plane.number]
    left_out: list[list[ndarray]] = [[] for _ in plane.number]
    for polygon, of, area in zip(each, outlines.label.tolist(), outlines.area.tolist(), strict=True):
        if of >= 0 and area != 0:
            (around if area > 0 else left_out)[of].append(polygon)
    return around, left_out
