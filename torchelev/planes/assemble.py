"""Regions in the map frame from labels and planes: outlines are traced and put onto their planes."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from torchelev.planes.lattice import Outlines, interior, trace_borders, trace_insets
from torchelev.planes.region_planes import RegionPlanes
from torchelev.planes.regions import Planes, Region
from torchelev.planes.sums import Surface

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray


class MapFrames(NamedTuple):
    """Where the cells of B maps of one size lie."""

    resolution: float  #: [m] of a cell
    corner: Float[ndarray, "B 2"]  #: [m] the lowest x and y of each map
    datum: Float[ndarray, "B"]  #: [m] height from which those of the surface are counted
    num_rows: int  #: of a map and the padding below it, H + 1

    def xy(self, number: Int[ndarray, "N"], cell: Float[ndarray, "N 2"]) -> Float[ndarray, "N 2"]:
        """Return x and y [m] of places of maps, given in cells from the corner."""
        return self.corner[number] + cell * self.resolution


def assemble_maps(
    labels: Int[ndarray, "P"], plane: RegionPlanes, surface: Surface, frames: MapFrames, margin: float
) -> list[Planes]:
    """Return the regions of each map with their polygons; insets keep `margin` [m] from the borders.

    Args:
        labels: region of each cell, -1 for none; the regions of a map follow each other.
        plane: the regions' planes, from their maps' centres and data.
        surface: the maps.
        frames: where they lie.
        margin: [m].
    """
    rows, stride = frames.num_rows, surface.shape[1] + 1
    cell = np.flatnonzero(labels >= 0)
    number = np.zeros(len(plane.number), np.int64)  # the map of each region
    number[labels[cell]] = cell // (rows * stride)
    x, y = frames.xy(number, np.array([(rows - 1) / 2, (stride - 1) / 2])).T
    plane = plane._replace(x0=plane.x0 + x, y0=plane.y0 + y, z0=plane.z0 + frames.datum[number])
    first = np.searchsorted(number, np.arange(len(frames.corner) + 1)).tolist()
    image = labels.reshape(-1, stride)
    regions = _assemble_regions(image[:-1, :-1], plane, number, frames, margin, first)
    parts = image.reshape(-1, rows, stride)[:, :-1, :-1]
    return [
        Planes(np.where(part >= 0, part - first[k], -1).astype(np.int32), tuple(regions[first[k] : first[k + 1]]))
        for k, part in enumerate(parts)
    ]


def _assemble_regions(
    labels: Int[ndarray, "R W"],
    plane: RegionPlanes,
    number: Int[ndarray, "K"],
    frames: MapFrames,
    margin: float,
    first: list[int],
) -> list[Region]:
    """Return the regions of all maps, labelled from 0 in each map, of which `first` are the first ones."""
    if len(plane.number) == 0:
        return []
    labels = labels.astype(np.int32)
    inside = interior(labels)
    outer, holes = _polygons(trace_borders(inside, labels), plane, number, frames)
    inset, inset_holes = _polygons(trace_insets(inside, labels, margin / frames.resolution), plane, number, frames)
    normal = np.column_stack([-plane.gradient_x, -plane.gradient_y, np.ones(len(plane.number))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    point = np.column_stack([plane.x0, plane.y0, plane.z0])
    label = np.arange(len(number)) - np.array(first)[number]
    area = plane.number * frames.resolution**2
    columns = (label.tolist(), normal, point, outer, holes, inset, inset_holes, area, plane.roughness)
    return [Region(k, n, p, borders[0], *rest) for k, n, p, borders, *rest in zip(*columns, strict=True)]


def _polygons(
    outlines: Outlines, plane: RegionPlanes, number: Int[ndarray, "K"], frames: MapFrames
) -> tuple[list[list[ndarray]], list[list[ndarray]]]:
    """Return each region's outer polygons and holes [m], on its plane."""
    label = np.repeat(outlines.label, outlines.length)
    cell = outlines.points / 2
    cell[:, 0] -= number[label] * frames.num_rows
    xy = frames.xy(number[label], cell)
    z = plane.z0[label] + plane.gradient_x[label] * (xy[:, 0] - plane.x0[label])
    z += plane.gradient_y[label] * (xy[:, 1] - plane.y0[label])
    points, end = np.column_stack([xy, z]), np.cumsum(outlines.length)
    ends = zip((end - outlines.length).tolist(), end.tolist(), strict=True)
    outer: list[list[ndarray]] = [[] for _ in number]
    holes: list[list[ndarray]] = [[] for _ in number]
    for (start, stop), region, area in zip(ends, outlines.label.tolist(), outlines.area.tolist(), strict=True):
        if region >= 0 and area != 0:
            (outer if area > 0 else holes)[region].append(points[start:stop])
    return outer, holes
