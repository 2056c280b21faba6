"""Polygons and points: inside, nearest, and the convex polygon that is free around a point. All in x and y."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray


def sides(polygons: Sequence[Float[ndarray, "_ D"]]) -> Float[ndarray, "S 2 2"]:
    """Return the sides of all polygons, each from a point to the next one, in x and y."""
    each = [np.stack([polygon[:, :2], np.roll(polygon[:, :2], -1, 0)], 1) for polygon in polygons]
    return np.concatenate([np.zeros((0, 2, 2)), *each])


def crossings(side: Float[ndarray, "S 2 2"], xy: Float[ndarray, "2"]) -> Bool[ndarray, "S"]:
    """Tell which sides a ray from the point along +x crosses: of an odd number of sides it lies inside."""
    start, end = side[:, 0], side[:, 1]
    spans = (start[:, 1] > xy[1]) != (end[:, 1] > xy[1])
    rise = np.where(spans, end[:, 1] - start[:, 1], 1.0)
    x = start[:, 0] + (xy[1] - start[:, 1]) * (end[:, 0] - start[:, 0]) / rise
    return spans & (x > xy[0])


def nearest(side: Float[ndarray, "S 2 2"], xy: Float[ndarray, "2"]) -> Float[ndarray, "S 2"]:
    """Return the point of each side that is nearest to a point."""
    along = side[:, 1] - side[:, 0]
    square = (along**2).sum(1)
    share = ((xy - side[:, 0]) * along).sum(1) / np.where(square > 0, square, 1.0)
    return side[:, 0] + share.clip(0, 1)[:, None] * along


def free_polygon(border: Float[ndarray, "S 2 2"], seed: Float[ndarray, "2"], margin: float) -> Float[ndarray, "V 2"]:
    """Return a convex polygon around `seed` that no side of the border enters, counter-clockwise.

    A circle grows around the seed. Where it touches the border, the tangent becomes a side of the polygon, `margin`
    nearer to the seed, and what lies behind the tangent no longer counts; until nothing is left in front. A side of
    the border is convex, so that it lies behind the tangent at its nearest point as a whole.
    """
    border = border - seed
    polygon = _box(border)
    while len(border):
        touch = nearest(border, np.zeros(2))
        distance = np.hypot(*touch.T)
        first = np.argmin(distance)
        normal = touch[first] / distance[first]
        polygon = _clip(polygon, normal, distance[first] - margin)
        border = _in_front(border, normal, distance[first])
    apart = np.hypot(*(np.roll(polygon, -1, 0) - polygon).T) > 1e-9  # where a tangent passes through a corner
    return polygon[apart] + seed


def _in_front(border: Float[ndarray, "S 2 2"], normal: Float[ndarray, "2"], offset: float) -> Float[ndarray, "R 2 2"]:
    """Return the parts of sides where normal . x < offset."""
    over = border @ normal - offset
    ahead = (over < -1e-9).any(1)
    border, over = border[ahead], over[ahead]
    crosses = (over > 0).any(1)
    share = over[:, 0] / np.where(crosses, over[:, 0] - over[:, 1], 1.0)
    cut = border[:, 0] + share[:, None] * (border[:, 1] - border[:, 0])
    return np.where((over > 0)[..., None], cut[:, None], border)


def _box(border: Float[ndarray, "S 2 2"]) -> Float[ndarray, "4 2"]:
    """Return the rectangle around the border."""
    (x0, y0), (x1, y1) = border.min((0, 1)), border.max((0, 1))
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _clip(polygon: Float[ndarray, "V 2"], normal: Float[ndarray, "2"], offset: float) -> Float[ndarray, "W 2"]:
    """Return the part of a convex polygon where normal . x <= offset."""
    over = polygon @ normal - offset
    after, over_after = np.roll(polygon, -1, 0), np.roll(over, -1)
    inside = over <= 0
    leaves = inside != (over_after <= 0)
    share = over / np.where(leaves, over - over_after, 1.0)
    cut = polygon + share[:, None] * (after - polygon)
    return np.stack([polygon, cut], 1)[np.stack([inside, leaves], 1)]
