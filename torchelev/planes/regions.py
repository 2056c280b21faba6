"""Planar regions and their polygons, and what planners and controllers ask of them."""

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
    """A planar region: the plane n . (x - point) = 0 and its polygons on it, all NumPy float64 in the map frame [m].

    Polygons do not repeat their first point. Seen from above, those that surround ground are counter-clockwise and
    those that leave ground out clockwise. They run along the sides of the region's cells; the inset's corners lie half
    a cell apart. They may touch themselves in a corner where two cells do.
    """

    label: int  #: of its cells in `Planes.labels`
    normal: Float[ndarray, "3"]  #: unit, up
    point: Float[ndarray, "3"]  #: on the plane, above the cells' mean x and y
    boundary: Float[ndarray, "K 3"] = field(repr=False)  #: [m] outer polygon, counter-clockwise, map frame
    holes: list[Float[ndarray, "_ 3"]] = field(repr=False)  #: [m] polygons inside the boundary, clockwise
    #: what is left of the region a margin away from its border and holes
    inset: list[Float[ndarray, "_ 3"]] = field(repr=False)
    inset_holes: list[Float[ndarray, "_ 3"]] = field(repr=False)  #: what to leave out of the inset
    area: float  #: [m^2] of its cells, projected onto x and y
    roughness: float  #: [m] root mean square distance of its cells from the plane

    @property
    def bounding_box(self) -> tuple[Float[ndarray, "2"], Float[ndarray, "2"]]:
        """The lowest and the highest x and y [m]."""
        return self.boundary[:, :2].min(0), self.boundary[:, :2].max(0)

    @property
    def T_map_plane(self) -> Float[ndarray, "4 4"]:
        """A frame on the plane at `point`: z is the normal, x lies above or below the map's x axis."""
        x = np.array([self.normal[2], 0.0, -self.normal[0]])
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3] = np.column_stack([x, np.cross(self.normal, x), self.normal, self.point])
        return T

    def onto(self, xy: Float[ndarray, "... 2"]) -> Float[ndarray, "... 3"]:
        """Return the points of the plane above or below x and y [m]."""
        gradient = -self.normal[:2] / self.normal[2]
        z = self.point[2] + (np.asarray(xy, float) - self.point[:2]) @ gradient
        return np.concatenate([xy, z[..., None]], -1)

    @cached_property
    def border(self) -> Float[ndarray, "S 2 2"]:
        """The sides of boundary and holes, in x and y."""
        return polygons.sides([self.boundary, *self.holes])

    @cached_property
    def inset_border(self) -> Float[ndarray, "S 2 2"]:
        """The sides of the inset and its holes, in x and y."""
        return polygons.sides([*self.inset, *self.inset_holes])


class Foothold(NamedTuple):
    """Where a foot can stand."""

    point: Float[ndarray, "3"]  #: [m] map frame, on the region's plane, in its inset
    region: Region  #: the region that carries it
    distance: float  #: [m] from the query, in x and y


@dataclass(frozen=True, eq=False)
class Planes:
    """The planar regions of one map."""

    labels: Int[ndarray, "H W"]  #: int32, -1: none
    regions: tuple[Region, ...] = field(repr=False)  #: regions[k] has label k

    def nearest_foothold(self, xy: Any) -> Foothold | None:
        """Return the point of the regions' insets that is nearest to (x, y) [m] in x and y; None if there is no inset.

        Raises ValueError unless xy is two finite numbers.
        """
        xy = _as_xy("xy", xy)
        side, owner = self._insets
        if len(side) == 0:
            return None
        crossed = np.bincount(owner, polygons.crossings(side, xy), len(self.regions))
        around = np.flatnonzero(crossed % 2)
        if len(around):
            region = self.regions[around[0]]
            return Foothold(region.onto(xy), region, 0.0)
        closest = polygons.nearest(side, xy)
        distance = np.hypot(*(closest - xy).T)
        best = int(np.argmin(distance))
        region = self.regions[owner[best]]
        return Foothold(region.onto(closest[best]), region, float(distance[best]))

    @cached_property
    def _insets(self) -> tuple[ndarray, ndarray]:
        """The sides of all insets, and the label of each."""
        side = [region.inset_border for region in self.regions]
        owner = np.repeat(np.arange(len(side)), [len(s) for s in side])
        return np.concatenate([np.zeros((0, 2, 2)), *side]), owner


def convex_region(region: Region, foothold_xy: Any, margin: float = 0.0) -> Float[ndarray, "V 3"]:
    """Return a convex polygon on the region's plane around a foothold, inside its boundary and free of its holes.

    A circle grows around the foothold; where it touches the border, the tangent becomes a side, and what lies behind
    it no longer counts, until no border is left in front. So each side touches the border, or stays `margin` [m] away
    from where it would. Counter-clockwise from above, the first point not repeated, map frame [m].

    Raises ValueError unless the foothold lies in the region and further than the margin from its border; what
    `nearest_foothold` returns does, for a margin below that of the inset.
    """
    xy = _as_xy("foothold_xy", foothold_xy)
    require(0 <= margin < math.inf, "margin", "must not be negative", margin, "give 0 for none")
    distance = np.hypot(*(polygons.nearest(region.border, xy) - xy).T).min()
    inside = polygons.crossings(region.border, xy).sum() % 2 == 1
    free = inside and distance > max(margin, 1e-6)
    actual = f"{tuple(xy.tolist())}, {distance:.3g} m {'inside' if inside else 'outside'}"
    rule = f"must lie in the region, more than {margin:g} m from its border"
    require(free, "foothold_xy", rule, actual, "take the x and y of nearest_foothold, or a smaller margin")
    return region.onto(polygons.free_polygon(region.border, xy, margin))


def _as_xy(name: str, xy: Any) -> Float[ndarray, "2"]:
    point = np.asarray(xy.detach().cpu() if isinstance(xy, Tensor) else xy, np.float64)
    point = point[:2] if point.shape == (3,) else point  # a foothold's own point
    good = point.shape == (2,) and bool(np.isfinite(point).all())
    require(good, name, "must be two finite numbers, x and y [m]", xy, "give (x, y) in the map frame")
    return point
