"""Planar regions and their polygons, with the queries of planners and controllers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from torch import Tensor

from torchelev.errors import require
from torchelev.planes import polygons

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray


@dataclass(frozen=True, eq=False)
class Region:
    """A planar region: the plane n . (x - point) = 0 and its polygons, NumPy float64 in the map frame [m].

    Polygons lie on the plane and do not repeat their first point. Seen from above, outer polygons are counter-clockwise
    and holes clockwise. They run along the sides of the region's cells; corners of the inset are half a cell apart.
    They may touch themselves at a corner where two cells do.
    """

    label: int  #: of its cells in `Planes.labels`
    normal: Float[ndarray, "3"]  #: unit vector, upwards
    point: Float[ndarray, "3"]  #: [m] on the plane, at the cells' mean x and y
    boundary: Float[ndarray, "K 3"] = field(repr=False)  #: [m] outer polygon
    holes: list[Float[ndarray, "_ 3"]] = field(repr=False)  #: [m] polygons inside the boundary
    #: [m] outer polygons of the part that keeps `PlaneConfig.margin` from boundary and holes
    inset: list[Float[ndarray, "_ 3"]] = field(repr=False)
    inset_holes: list[Float[ndarray, "_ 3"]] = field(repr=False)  #: [m] holes of the inset
    area: float  #: [m^2] of its cells, projected onto x and y
    roughness: float  #: [m] root mean square distance of its cells from the plane

    @property
    def bounding_box(self) -> tuple[Float[ndarray, "2"], Float[ndarray, "2"]]:
        """The lowest and the highest x and y [m] of the boundary."""
        return self.boundary[:, :2].min(0), self.boundary[:, :2].max(0)

    @property
    def T_map_plane(self) -> Float[ndarray, "4 4"]:
        """The pose of the plane at `point`: z is the normal, and x has no component along the map's y axis."""
        x = np.array([self.normal[2], 0.0, -self.normal[0]])
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3] = np.column_stack([x, np.cross(self.normal, x), self.normal, self.point])
        return T

    def onto(self, xy: Float[ndarray, "... 2"]) -> Float[ndarray, "... 3"]:
        """Return the points [m] of the plane at x and y."""
        gradient = -self.normal[:2] / self.normal[2]
        z = self.point[2] + (np.asarray(xy, float) - self.point[:2]) @ gradient
        return np.concatenate([xy, z[..., None]], -1)

    @cached_property
    def border(self) -> Float[ndarray, "S 2 2"]:
        """The sides [m] of boundary and holes, in x and y."""
        return polygons.sides([self.boundary, *self.holes])

    @cached_property
    def inset_border(self) -> Float[ndarray, "S 2 2"]:
        """The sides [m] of the inset and its holes, in x and y."""
        return polygons.sides([*self.inset, *self.inset_holes])


class Foothold(NamedTuple):
    """A point where a foot can stand."""

    point: Float[ndarray, "3"]  #: [m] map frame, on the region's plane, in its inset
    region: Region  #: the region that carries it
    distance: float  #: [m] from the query, in x and y


@dataclass(frozen=True, eq=False)
class Planes:
    """The planar regions of one map."""

    labels: Int[ndarray, "H W"]  #: int32, region of each cell; -1: none
    regions: tuple[Region, ...] = field(repr=False)  #: regions[k] has label k

    def nearest_foothold(self, xy: Any) -> Foothold | None:
        """Return the point in any region's inset that is nearest to (x, y), measured in x and y.

        Args:
            xy: (2,) or (3,) [m], map frame; z is ignored.

        Returns:
            The foothold, or None if no region has an inset.

        Raises:
            ValueError: if `xy` is not two or three finite numbers.
        """
        xy = _as_xy("xy", xy)
        side, owner = self._inset_sides
        if len(side) == 0:
            return None
        num_crossings = np.bincount(owner, polygons.ray_crosses(side, xy), len(self.regions))
        containing = np.flatnonzero(num_crossings % 2)
        if len(containing):
            region = self.regions[containing[0]]
            return Foothold(region.onto(xy), region, 0.0)
        nearest = polygons.nearest_points(side, xy)
        distance = np.hypot(*(nearest - xy).T)
        best = int(np.argmin(distance))
        region = self.regions[owner[best]]
        return Foothold(region.onto(nearest[best]), region, float(distance[best]))

    @cached_property
    def _inset_sides(self) -> tuple[ndarray, ndarray]:
        """The sides of all insets, and the label of each."""
        side = [region.inset_border for region in self.regions]
        owner = np.repeat(np.arange(len(side)), [len(s) for s in side])
        return np.concatenate([np.zeros((0, 2, 2)), *side]), owner


def convex_region(region: Region, foothold_xy: Any, margin: float = 0.0) -> Float[ndarray, "V 3"]:
    """Return a convex polygon on the region's plane around a foothold, inside its boundary and clear of its holes.

    A circle grows around the foothold. Where it touches the border, the tangent becomes a side of the polygon, and the
    border behind it no longer counts, until no border is left. So each side touches the border, or keeps `margin` from
    the tangent.

    Args:
        region: contains the foothold.
        foothold_xy: (2,) or (3,) [m], map frame; z is ignored. What `nearest_foothold` returns is valid for margins
            below that of the inset.
        margin: [m] between the polygon and the border.

    Returns:
        (V, 3) [m], map frame, counter-clockwise from above, without repeating the first point.

    Raises:
        ValueError: if the foothold is outside the region or within the margin of its border, or the margin is negative.
    """
    xy = _as_xy("foothold_xy", foothold_xy)
    require(0 <= margin < math.inf, "margin", "must not be negative", margin, "give 0 for none")
    distance = np.hypot(*(polygons.nearest_points(region.border, xy) - xy).T).min()
    is_inside = polygons.ray_crosses(region.border, xy).sum() % 2 == 1
    is_free = is_inside and distance > max(margin, 1e-6)
    actual = f"{tuple(xy.tolist())}, {distance:.3g} m {'inside' if is_inside else 'outside'}"
    rule = f"must lie in the region, more than {margin:g} m from its border"
    require(is_free, "foothold_xy", rule, actual, "take the x and y of nearest_foothold, or a smaller margin")
    return region.onto(polygons.free_polygon(region.border, xy, margin))


def _as_xy(name: str, xy: Any) -> Float[ndarray, "2"]:
    point = np.asarray(xy.detach().cpu() if isinstance(xy, Tensor) else xy, np.float64)
    point = point[:2] if point.shape == (3,) else point  # a foothold's own point
    is_valid = point.shape == (2,) and bool(np.isfinite(point).all())
    require(is_valid, name, "must be two finite numbers, x and y [m]", xy, "give (x, y) in the map frame")
    return point
