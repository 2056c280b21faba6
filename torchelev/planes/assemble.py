"""Regions in the map frame from labels and planes: outlines are traced and put onto their planes."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from torchelev.planes.lattice import Outlines, interior, trace_borders, trace_insets
from torchelev.planes.region_planes import RegionPlanes
from torchelev.planes.regions import Region

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray


class GridFrame(NamedTuple):
    """Where the cells of one map lie."""

    resolution: float  #: [m] of a cell
    corner: Float[ndarray, "2"]  #: [m] the lowest x and y of the map

    def xy(self, cell: ndarray) -> Float[ndarray, "... 2"]:
        """Return x and y [m] of places given in cells from the corner."""
        return self.corner + cell * self.resolution


def assemble_regions(
    labels: Int[ndarray, "H W"], plane: RegionPlanes, frame: GridFrame, margin: float
) -> tuple[Region, ...]:
    """Return the regions with their polygons; insets keep `margin` [m] from the borders."""
    if len(plane.number) == 0:
        return ()
    inside = interior(labels)
    outer, holes = _polygons(trace_borders(inside, labels), plane, frame)
    inset, inset_holes = _polygons(trace_insets(inside, labels, margin / frame.resolution), plane, frame)
    normal = np.column_stack([-plane.gradient_x, -plane.gradient_y, np.ones(len(plane.number))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    point = np.column_stack([plane.x0, plane.y0, plane.z0])
    area = plane.number * frame.resolution**2
    return tuple(
        Region(k, normal[k], point[k], outer[k][0], holes[k], inset[k], inset_holes[k], area[k], plane.roughness[k])
        for k in range(len(area))
    )


def _polygons(
    outlines: Outlines, plane: RegionPlanes, frame: GridFrame
) -> tuple[list[list[ndarray]], list[list[ndarray]]]:
    """Return each region's outer polygons and holes [m], on its plane."""
    label = np.repeat(outlines.label, outlines.length)
    xy = frame.xy(outlines.points / 2)
    z = plane.z0[label] + plane.gradient_x[label] * (xy[:, 0] - plane.x0[label])
    z += plane.gradient_y[label] * (xy[:, 1] - plane.y0[label])
    polygons = np.split(np.column_stack([xy, z]), np.cumsum(outlines.length))[:-1]  # the last part is empty
    outer: list[list[ndarray]] = [[] for _ in plane.number]
    holes: list[list[ndarray]] = [[] for _ in plane.number]
    for polygon, region, area in zip(polygons, outlines.label.tolist(), outlines.area.tolist(), strict=True):
        if region >= 0 and area != 0:
            (outer if area > 0 else holes)[region].append(polygon)
    return outer, holes
