"""The cells of a map and the lines between them as one image: connected components and polygons of regions.

Pixel (2i + 1, 2j + 1) of the image (2H + 1, 2W + 1) is cell (i, j); the pixels around it are its sides and corners.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Int
    from numpy import ndarray


class Outlines(NamedTuple):
    """Closed polygons in pixels of the lattice, one after the other, with their region on the left."""

    points: Int[ndarray, "P 2"]  #: corners of all outlines, one after the other, in cells
    length: Int[ndarray, "C"]  #: points of each polygon
    area: Int[ndarray, "C"]  #: [pixels^2] twice the area; negative where it is a hole
    label: Int[ndarray, "C"]  #: region of each outline


def _open(cells: Bool[ndarray, "H W"], along_x: Bool[ndarray, "H-1 W"], along_y: Bool[ndarray, "H W-1"]) -> ndarray:
    """Return the lattice: 1 for cells and for the sides between joined cells, 0 elsewhere."""
    H, W = cells.shape
    lattice = np.zeros((2 * H + 1, 2 * W + 1), np.uint8)
    lattice[1::2, 1::2] = cells
    lattice[2:-1:2, 1::2] = along_x
    lattice[1::2, 2:-1:2] = along_y
    return lattice


def components(
    cells: Bool[ndarray, "H W"], along_x: Bool[ndarray, "H-1 W"], along_y: Bool[ndarray, "H W-1"]
) -> tuple[Int[ndarray, "H W"], int]:
    """Label what hangs together over joined sides from 0 on (-1: no cell), and count it."""
    import cv2

    count, labels = cv2.connectedComponents(_open(cells, along_x, along_y), connectivity=4, ltype=cv2.CV_32S)
    return labels[1::2, 1::2] - 1, count - 1


def same(labels: Int[ndarray, "H W"]) -> tuple[ndarray, ndarray, ndarray]:
    """Return which cells have a label, and which have that of the next cell along x and y."""
    known = labels >= 0
    return known, (labels[1:] == labels[:-1]) & known[1:], (labels[:, 1:] == labels[:, :-1]) & known[:, 1:]


def interior(labels: Int[ndarray, "H W"]) -> ndarray:
    """Return the lattice with 1 inside regions and 0 on their borders and outside."""
    known, along_x, along_y = same(labels)
    lattice = _open(known, along_x, along_y)
    lattice[2:-1:2, 2:-1:2] = along_x[:, 1:] & along_x[:, :-1] & along_y[1:] & along_y[:-1]
    return lattice


def borders(inside: Int[ndarray, "2H+1 2W+1"], labels: Int[ndarray, "H W"]) -> Outlines:
    """Trace the borders of all regions along the sides of their cells. Each region is one 4-connected component.

    Everything but the insides of regions is traced as one shape: each region is a hole in it, and what lies within a
    region is a shape of its own. A contour that is traced in 8 directions cuts corners, which are put back.
    """
    return _outlines(1 - inside, labels, of_holes=True)


def insets(inside: Int[ndarray, "2H+1 2W+1"], labels: Int[ndarray, "H W"], margin: float) -> Outlines:
    """Trace what is at least `margin` [cells] inside its region, to half a cell."""
    import cv2

    distance = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return _outlines((distance >= max(1.0, 2 * margin - 1e-4)).astype(np.uint8), labels, of_holes=False)


def _outlines(image: ndarray, labels: ndarray, of_holes: bool) -> Outlines:
    """Trace the shapes of an image, or the holes in them, and give each contour the label that lies left of it."""
    import cv2

    found, hierarchy = cv2.findContours(image, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    if len(found) == 0:
        return Outlines(*(np.zeros(shape, int) for shape in ((0, 2), 0, 0, 0)))
    points = np.concatenate(found).reshape(-1, 2)[:, ::-1].astype(np.int64)
    length = np.array([len(contour) for contour in found])
    surrounds = (hierarchy.reshape(-1, 4)[:, 3] >= 0) == of_holes  # the others lie within a region
    points = _turned(points, length, surrounds)
    if of_holes:
        points, length = _with_corners(points, length)
    start = _starts(length)
    area = np.add.reduceat(_cross(points, length), start)
    label = _label_left(points, start, labels) if of_holes else labels[tuple(points[start].T // 2)]
    return Outlines(points, length, area, label)


def _starts(length: Int[ndarray, "C"]) -> Int[ndarray, "C"]:
    return np.cumsum(length) - length


def _following(length: Int[ndarray, "C"]) -> Int[ndarray, "P"]:
    """Return the number of the point that follows each point in its polygon."""
    after = np.arange(1, length.sum() + 1)
    start = _starts(length)
    after[start + length - 1] = start
    return after


def _cross(points: Int[ndarray, "P 2"], length: Int[ndarray, "C"]) -> Int[ndarray, "P"]:
    """Return twice the signed area under each side."""
    after = points[_following(length)]
    return points[:, 0] * after[:, 1] - after[:, 0] * points[:, 1]


def _turned(points: Int[ndarray, "P 2"], length: Int[ndarray, "C"], surrounds: Bool[ndarray, "C"]) -> ndarray:
    """Turn polygons around where their region would lie on the right."""
    start = _starts(length)
    flip = (np.add.reduceat(_cross(points, length), start) > 0) != surrounds
    order = np.arange(len(points))
    mirrored = np.repeat(2 * start + length - 1, length) - order
    return points[np.where(np.repeat(flip, length), mirrored, order)]


def _with_corners(points: Int[ndarray, "P 2"], length: Int[ndarray, "C"]) -> tuple[ndarray, ndarray]:
    """Put the corners of cells back that diagonal steps cut off, and leave out what is no corner.

    A corner has two even coordinates. A diagonal step leads from a side along one axis, with one odd coordinate, to a
    side along the other.
    """
    after = points[_following(length)]
    corner = np.where(points % 2 == 0, points, after)
    both = np.stack([points, corner], 1).reshape(-1, 2)
    keep = np.stack([(points % 2 == 0).all(1), (points != after).all(1)], 1)
    return both[keep.ravel()], np.add.reduceat(keep.sum(1), _starts(length))


def _label_left(points: Int[ndarray, "P 2"], start: Int[ndarray, "C"], labels: Int[ndarray, "H W"]) -> ndarray:
    """Return the label of the cell to the left of each polygon's first side, -1 outside the map."""
    ahead = np.sign(points[start + 1] - points[start])
    pixel = points[start] + ahead + np.stack([-ahead[:, 1], ahead[:, 0]], 1)
    rimmed = np.pad(labels, 1, constant_values=-1)
    return rimmed[tuple((pixel + 1).T // 2)]
