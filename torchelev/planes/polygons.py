"""Polygons and points in x and y: inside, nearest, and the free convex polygon around a point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray


def sides(polygons: Sequence[Float[ndarray, "_ D"]]) -> Float[ndarray, "S 2 2"]:
    """Return the sides of all polygons, each as its two end points in x and y."""
    each = [np.stack([polygon[:, :2], np.roll(polygon[:, :2], -1, 0)], 1) for polygon in polygons]
    return np.concatenate([np.zeros((0, 2, 2)), *each])


def ray_crosses(side: Float[ndarray, "S 2 2"], xy: Float[ndarray, "2"]) -> Bool[ndarray, "S"]:
    """Return which sides a ray from the point along +x crosses; inside a polygon their number is odd."""
    start, end = side[:, 0], side[:, 1]
    spans = (start[:, 1] > xy[1]) != (end[:, 1] > xy[1])
    rise = np.where(spans, end[:, 1] - start[:, 1], 1.0)
    x = start[:, 0] + (xy[1] - start[:, 1]) * (end[:, 0] - start[:, 0]) / rise
    return spans & (x > xy[0])


def nearest_points(side: Float[ndarray, "S 2 2"], xy: Float[ndarray, "2"]) -> Float[ndarray, "S 2"]:
    """Return the point of each side that is nearest to a point."""
    along = side[:, 1] - side[:, 0]
    square = (along**2).sum(1)
    fraction = ((xy - side[:, 0]) * along).sum(1) / np.where(square > 0, square, 1.0)
    return side[:, 0] + fraction.clip(0, 1)[:, None] * along


def free_polygon(border: Float[ndarray, "S 2 2"], seed: Float[ndarray, "2"], margin: float) -> Float[ndarray, "V 2"]:
    """Return a convex polygon around `seed`, counter-clockwise, that no side of the border enters.

    A circle grows around the seed. Where it touches the border, the tangent, moved `margin` towards the seed, becomes a
    side of the polygon, and the border behind the tangent no longer counts. This repeats until no border is left. As a
    side of the border is straight, it lies entirely behind the tangent at its nearest point.
    """
    border = border - seed
    polygon = _bounding_rectangle(border)
    while len(border):
        touch = nearest_points(border, np.zeros(2))
        distance = np.hypot(*touch.T)
        first = np.argmin(distance)
        normal = touch[first] / distance[first]
        polygon = _clip(polygon, normal, distance[first] - margin)
        border = _in_front(border, normal, distance[first])
    is_corner = np.hypot(*(np.roll(polygon, -1, 0) - polygon).T) > 1e-9  # a tangent through a corner repeats it
    return polygon[is_corner] + seed


def _in_front(border: Float[ndarray, "S 2 2"], normal: Float[ndarray, "2"], offset: float) -> Float[ndarray, "R 2 2"]:
    """Return the parts of sides where normal . x < offset."""
    excess = border @ normal - offset
    is_ahead = (excess < -1e-9).any(1)
    border, excess = border[is_ahead], excess[is_ahead]
    crosses = (excess > 0).any(1)
    fraction = excess[:, 0] / np.where(crosses, excess[:, 0] - excess[:, 1], 1.0)
    cut = border[:, 0] + fraction[:, None] * (border[:, 1] - border[:, 0])
    return np.where((excess > 0)[..., None], cut[:, None], border)


def _bounding_rectangle(border: Float[ndarray, "S 2 2"]) -> Float[ndarray, "4 2"]:
    (x0, y0), (x1, y1) = border.min((0, 1)), border.max((0, 1))
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _clip(polygon: Float[ndarray, "V 2"], normal: Float[ndarray, "2"], offset: float) -> Float[ndarray, "W 2"]:
    """Return the part of a convex polygon where normal . x <= offset."""
    excess = polygon @ normal - offset
    after, excess_after = np.roll(polygon, -1, 0), np.roll(excess, -1)
    is_inside = excess <= 0
    leaves = is_inside != (excess_after <= 0)
    fraction = excess / np.where(leaves, excess - excess_after, 1.0)
    cut = polygon + fraction[:, None] * (after - polygon)
    return np.stack([polygon, cut], 1)[np.stack([is_inside, leaves], 1)]
