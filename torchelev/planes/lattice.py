"""Connected components and outlines of regions, traced on a lattice: an image of the cells and of the lines between.

Pixel (2i + 1, 2j + 1) of the image (2H + 1, 2W + 1) is cell (i, j); the pixels around it are its sides and corners.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Int
    from numpy import ndarray

_FAR = 8.0  # [half cells] up to which an erosion is faster than a distance transform


class Outlines(NamedTuple):
    """Closed polygons in lattice pixels, one after the other, each with its region on the left."""

    points: Int[ndarray, "P 2"]  #: corners of all polygons, [half cells]
    length: Int[ndarray, "C"]  #: number of corners of each polygon
    area: Int[ndarray, "C"]  #: twice the signed area [half cells^2]; negative for holes
    label: Int[ndarray, "C"]  #: region of each polygon


def _draw(cells: Bool[ndarray, "H W"], along_x: Bool[ndarray, "H-1 W"], along_y: Bool[ndarray, "H W-1"]) -> ndarray:
    """Return the lattice with 1 for cells and for the sides between joined cells."""
    H, W = cells.shape
    lattice = np.zeros((2 * H + 1, 2 * W + 1), np.uint8)
    lattice[1::2, 1::2] = cells
    lattice[2:-1:2, 1::2] = along_x
    lattice[1::2, 2:-1:2] = along_y
    return lattice


def components(
    cells: Bool[ndarray, "H W"], along_x: Bool[ndarray, "H-1 W"], along_y: Bool[ndarray, "H W-1"]
) -> tuple[Int[ndarray, "H W"], int]:
    """Label the components connected over joined sides, from 0 (-1: no cell), and count them."""
    import cv2

    count, labels = cv2.connectedComponents(_draw(cells, along_x, along_y), connectivity=4, ltype=cv2.CV_32S)
    return labels[1::2, 1::2] - 1, count - 1


def same_label(labels: Int[ndarray, "H W"]) -> tuple[ndarray, ndarray, ndarray]:
    """Return which cells have a label, and which share it with the next cell along x and along y."""
    has_label = labels >= 0
    along_x = (labels[1:] == labels[:-1]) & has_label[1:]
    return has_label, along_x, (labels[:, 1:] == labels[:, :-1]) & has_label[:, 1:]


def interior(labels: Int[ndarray, "H W"]) -> ndarray:
    """Return the lattice with 1 inside regions, 0 on their borders and outside."""
    has_label, along_x, along_y = same_label(labels)
    lattice = _draw(has_label, along_x, along_y)
    lattice[2:-1:2, 2:-1:2] = along_x[:, 1:] & along_x[:, :-1] & along_y[1:] & along_y[:-1]
    return lattice


def trace_borders(inside: Int[ndarray, "2H+1 2W+1"], labels: Int[ndarray, "H W"]) -> Outlines:
    """Trace the borders of all regions along the sides of their cells. Each region is one 4-connected component.

    The complement of the regions' interiors is traced as one shape: each region is a hole in it, and each hole of a
    region a shape of its own. OpenCV traces in 8 directions and cuts corners, which are put back.
    """
    return _trace(1 - inside, labels, of_holes=True)


def trace_insets(inside: Int[ndarray, "2H+1 2W+1"], labels: Int[ndarray, "H W"], margin: float) -> Outlines:
    """Trace the part of each region at least `margin` [cells] from its border, to half a cell."""
    import cv2

    reach = max(1.0, 2 * margin - 1e-4)
    if reach > _FAR:
        distance = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        return _trace((distance >= reach).astype(np.uint8), labels, of_holes=False)
    # The same, several times as fast: what no pixel outside is nearer to.
    return _trace(cv2.erode(inside, disc(reach)), labels, of_holes=False)


def disc(radius: float) -> Int[ndarray, "N N"]:
    """Return the pixels nearer than `radius` to the middle one."""
    reach = math.ceil(radius) - 1
    away = np.arange(-reach, reach + 1) ** 2
    return (away[:, None] + away < radius**2).astype(np.uint8)


def _trace(image: ndarray, labels: ndarray, of_holes: bool) -> Outlines:
    """Trace the shapes of an image, or the holes in them, and label each contour by the region on its left."""
    import cv2

    found, hierarchy = cv2.findContours(image, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    if len(found) == 0:
        return Outlines(*(np.zeros(shape, int) for shape in ((0, 2), 0, 0, 0)))
    points = np.concatenate(found).reshape(-1, 2)[:, ::-1].astype(np.int64)
    length = np.array([len(contour) for contour in found])
    is_outer = (hierarchy.reshape(-1, 4)[:, 3] >= 0) == of_holes  # the rest are holes of regions
    points = _orient(points, length, is_outer)
    if of_holes:
        points, length = _restore_corners(points, length)
    start = _starts(length)
    area = np.add.reduceat(_cross(points, length), start)
    label = _label_on_the_left(points, start, labels) if of_holes else labels[tuple(points[start].T // 2)]
    return Outlines(points, length, area, label)


def _starts(length: Int[ndarray, "C"]) -> Int[ndarray, "C"]:
    """Return the index of each polygon's first point."""
    return np.cumsum(length) - length


def _next_point(length: Int[ndarray, "C"]) -> Int[ndarray, "P"]:
    """Return the index of the next point in the same polygon."""
    after = np.arange(1, length.sum() + 1)
    start = _starts(length)
    after[start + length - 1] = start
    return after


def _cross(points: Int[ndarray, "P 2"], length: Int[ndarray, "C"]) -> Int[ndarray, "P"]:
    """Return the cross product of each point and the next one; they sum to twice the signed area."""
    after = points[_next_point(length)]
    return points[:, 0] * after[:, 1] - after[:, 0] * points[:, 1]


def _orient(points: Int[ndarray, "P 2"], length: Int[ndarray, "C"], is_outer: Bool[ndarray, "C"]) -> ndarray:
    """Reverse polygons whose region would lie on the right."""
    start = _starts(length)
    flip = (np.add.reduceat(_cross(points, length), start) > 0) != is_outer
    order = np.arange(len(points))
    mirrored = np.repeat(2 * start + length - 1, length) - order
    return points[np.where(np.repeat(flip, length), mirrored, order)]


def _restore_corners(points: Int[ndarray, "P 2"], length: Int[ndarray, "C"]) -> tuple[ndarray, ndarray]:
    """Restore the cells' corners that diagonal steps cut off, and drop the points that are not corners.

    A corner has two even coordinates. A diagonal step leads from a side along one axis, with one odd coordinate, to a
    side along the other.
    """
    after = points[_next_point(length)]
    corner = np.where(points % 2 == 0, points, after)
    both = np.stack([points, corner], 1).reshape(-1, 2)
    keep = np.stack([(points % 2 == 0).all(1), (points != after).all(1)], 1)
    return both[keep.ravel()], np.add.reduceat(keep.sum(1), _starts(length))


def _label_on_the_left(
    points: Int[ndarray, "P 2"], start: Int[ndarray, "C"], labels: Int[ndarray, "H W"]
) -> Int[ndarray, "C"]:
    """Return the label of the cell left of each polygon's first side, -1 outside the map."""
    ahead = np.sign(points[start + 1] - points[start])
    pixel = points[start] + ahead + np.stack([-ahead[:, 1], ahead[:, 0]], 1)
    rimmed = np.pad(labels, 1, constant_values=-1)
    return rimmed[tuple((pixel + 1).T // 2)]
