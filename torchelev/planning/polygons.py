"""Rasterize polygons on small patches of cells, independent of the map's size, and enclose cells in convex hulls."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchelev.ops.scatter import cell_sums

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class PolygonCells(NamedTuple):
    """The cells of P polygons on each of B maps, on a patch of S x S cells around each polygon."""

    first: Int[Tensor, "B P 2"]  #: cell (i, j) at the patch's index [0, 0], counted from the vertices' origin
    inside: Bool[Tensor, "B P S S"]  #: True where the cell belongs to the polygon


class _Edges(NamedTuple):
    """Polygon edges [cells] in order of increasing x, so that the polygon's orientation does not matter."""

    x0: Float[Tensor, "B P V 1"]
    y0: Float[Tensor, "B P V 1"]
    x1: Float[Tensor, "B P V 1"]
    y1: Float[Tensor, "B P V 1"]


def rasterize(uv: Float[Tensor, "B P V 2"], size: int) -> PolygonCells:
    """Mark the cells of each polygon on a patch of `size` x `size` cells.

    A cell belongs to a polygon if its centre lies inside, by the even-odd rule; a centre on an edge that two polygons
    share belongs to one of them. A polygon that contains no centre gets the cells that its boundary crosses, sampled
    every 0.71 cells or closer, so that every polygon has at least one cell.

    Args:
        uv: vertices [cells]. A polygon may extend over at most `size` - 1 cells along x and y; the part beyond is
            ignored.
        size: side of the patch [cells].
    """
    first = torch.floor(uv.amin(-2))
    edges = _edges(uv - first[..., None, :])
    has_centre = _contains_centre(edges, size)
    on_boundary = _boundary_crosses(edges, size)
    inside = has_centre | (on_boundary & ~has_centre.flatten(-2).any(-1)[..., None, None])
    return PolygonCells(first.to(torch.int64), inside)


def _edges(vertices: Float[Tensor, "B P V 2"]) -> _Edges:
    x, y = vertices[..., None].unbind(-2)
    x_next, y_next = (values.roll(-1, -2) for values in (x, y))
    swap = x > x_next
    start = (torch.where(swap, after, before) for before, after in ((x, x_next), (y, y_next)))
    end = (torch.where(swap, before, after) for before, after in ((x, x_next), (y, y_next)))
    return _Edges(*start, *end)


def _contains_centre(edges: _Edges, size: int) -> Bool[Tensor, "B P S S"]:
    """Mark the cells whose centre is inside: an odd number of edges crosses their row before the centre.

    Each edge adds 1 to the first cell behind its crossing, and a cumulative sum along the row counts the crossings.
    The cost is S * V + S^2, not S^2 * V.
    """
    x0, y0, x1, y1 = edges
    row = torch.arange(size, device=x0.device)
    centre = row + 0.5
    crosses = (x0 <= centre) & (centre < x1)
    y = y0 + (centre - x0) / torch.where(crosses, x1 - x0, 1.0) * (y1 - y0)
    column = torch.where(crosses, torch.floor(y + 0.5).clamp(0, size), size)
    crossings = _count(row * (size + 1) + column.to(torch.int64), size, size + 1)
    return (crossings[..., :size].cumsum(-1).to(torch.int32) & 1).bool()


def _boundary_crosses(edges: _Edges, size: int) -> Bool[Tensor, "B P S S"]:
    """Mark the cells that hold a sample of the boundary."""
    x0, y0, x1, y1 = edges
    along = torch.arange(2 * size + 1, device=x0.device, dtype=x0.dtype) / (2 * size)
    i, j = (torch.floor(a + (b - a) * along).clamp(0, size - 1).to(torch.int64) for a, b in ((x0, x1), (y0, y1)))
    return _count(i * size + j, size, size) > 0.5


def _count(cell: Int[Tensor, "B P V M"], rows: int, columns: int) -> Float[Tensor, "B P H W"]:
    """Count how often each cell number of a patch (rows, columns) occurs."""
    index = cell.flatten(0, 1).flatten(1)
    ones = torch.ones(1, *index.shape, device=index.device)
    return cell_sums(index, ones, rows * columns)[0].view(*cell.shape[:2], rows, columns)


def convex_hull(cells: np.ndarray) -> np.ndarray:
    """Return the convex hull (K, 2) of marked cells (S, S): counter-clockwise, in cells from the corner of [0, 0].

    Monotone chain (A. M. Andrew, 1979) over the corners of the cells.
    """
    i, j = (index.tolist() for index in np.nonzero(cells))
    corners = sorted({(a + x, b + y) for a, b in zip(i, j, strict=True) for x in (0, 1) for y in (0, 1)})
    chains = [_lower_chain(corners), _lower_chain(corners[::-1])]
    return np.array([point for chain in chains for point in chain[:-1]], dtype=np.float64).reshape(-1, 2)


def _lower_chain(points: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Keep the points of a sorted list at which the hull turns left."""
    chain: list[tuple[int, int]] = []
    for x, y in points:
        while len(chain) > 1 and _cross(*chain[-2], *chain[-1], x, y) <= 0:
            chain.pop()
        chain.append((x, y))
    return chain


def _cross(ax: int, ay: int, bx: int, by: int, cx: int, cy: int) -> int:
    """Return the cross product of a->b and a->c."""
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
