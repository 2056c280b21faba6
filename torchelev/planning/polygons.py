"""Which cells lie in a polygon: marked on a small patch of cells around it, whatever the size of the map."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchelev.ops.operators import cell_sums

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class PolygonCells(NamedTuple):
    """The cells of P polygons for each of B maps, on a square patch of S x S cells around each polygon."""

    first: Int[Tensor, "B P 2"]  #: the patch's cell [0, 0], in cells from where the polygons are counted
    inside: Bool[Tensor, "B P S S"]  #: the cell belongs to the polygon


class Edges(NamedTuple):
    """The edges of polygons, each from its end of smaller x: so the same whichever way the polygon runs."""

    x0: Float[Tensor, "B P V 1"]  #: [m] of each edge's start
    y0: Float[Tensor, "B P V 1"]  #: [m] of each edge's start
    x1: Float[Tensor, "B P V 1"]  #: [m] of each edge's end
    y1: Float[Tensor, "B P V 1"]  #: [m] of each edge's end


def polygon_cells(uv: Float[Tensor, "B P V 2"], size: int) -> PolygonCells:
    """Mark the cells whose centres lie in each polygon by the even-odd rule; `uv` are its vertices, in cells.

    Of two polygons that share an edge, a centre on the edge belongs to one. A polygon without any centre, one smaller
    than a cell or narrower, has the cells that its boundary passes, sampled every 0.71 cells or closer, so that no
    polygon is without cells. It must extend no farther than `size` - 1 cells along x and y; what does is left out.
    """
    first = torch.floor(uv.amin(-2))
    edges = _edges(uv - first[..., None, :])
    centred = _holds_centre(edges, size)
    passed = _boundary_passes(edges, size)
    inside = centred | (passed & ~centred.flatten(-2).any(-1)[..., None, None])
    return PolygonCells(first.to(torch.int64), inside)


def _edges(vertices: Float[Tensor, "B P V 2"]) -> Edges:
    x, y = vertices[..., None].unbind(-2)
    x_next, y_next = (values.roll(-1, -2) for values in (x, y))
    turn = x > x_next
    start = (torch.where(turn, after, before) for before, after in ((x, x_next), (y, y_next)))
    end = (torch.where(turn, before, after) for before, after in ((x, x_next), (y, y_next)))
    return Edges(*start, *end)


def _holds_centre(edges: Edges, size: int) -> Bool[Tensor, "B P S S"]:
    """Tell which cells' centres lie inside: with an odd number of edges below them, along their row.

    Each edge is entered once per row, at the first cell whose centre lies beyond it, and the rows are summed up: cost
    grows with S * V + S^2, not with S^2 * V.
    """
    x0, y0, x1, y1 = edges
    row = torch.arange(size, device=x0.device)
    centre = row + 0.5
    crosses = (x0 <= centre) & (centre < x1)
    y = y0 + (centre - x0) / torch.where(crosses, x1 - x0, 1.0) * (y1 - y0)
    column = torch.where(crosses, torch.floor(y + 0.5).clamp(0, size), size)
    entered = _sum_cells(row * (size + 1) + column.to(torch.int64), size, size + 1)
    return (entered[..., :size].cumsum(-1).to(torch.int32) & 1).bool()


def _boundary_passes(edges: Edges, size: int) -> Bool[Tensor, "B P S S"]:
    x0, y0, x1, y1 = edges
    along = torch.arange(2 * size + 1, device=x0.device, dtype=x0.dtype) / (2 * size)
    i, j = (torch.floor(a + (b - a) * along).clamp(0, size - 1).to(torch.int64) for a, b in ((x0, x1), (y0, y1)))
    return _sum_cells(i * size + j, size, size) > 0.5


def _sum_cells(slot: Int[Tensor, "B P V M"], rows: int, columns: int) -> Float[Tensor, "B P H W"]:
    """Count how often each cell of (rows, columns) occurs."""
    index = slot.flatten(0, 1).flatten(1)
    ones = torch.ones(1, *index.shape, device=index.device)
    return cell_sums(index, ones, rows * columns)[0].view(*slot.shape[:2], rows, columns)


def convex_hull(cells: np.ndarray) -> np.ndarray:
    """Return the convex hull of marked cells (S, S), counter-clockwise, in cells from the first one's corner."""
    i, j = (index.tolist() for index in np.nonzero(cells))
    corners = sorted({(a + x, b + y) for a, b in zip(i, j, strict=True) for x in (0, 1) for y in (0, 1)})
    half = [_turning_left(corners), _turning_left(corners[::-1])]
    return np.array([point for points in half for point in points[:-1]], dtype=np.float64).reshape(-1, 2)


def _turning_left(points: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Drop the points that do not lie on the lower chain (monotone chain, A. M. Andrew, 1979)."""
    chain: list[tuple[int, int]] = []
    for x, y in points:
        while len(chain) > 1 and _cross(*chain[-2], *chain[-1], x, y) <= 0:
            chain.pop()
        chain.append((x, y))
    return chain


def _cross(ax: int, ay: int, bx: int, by: int, cx: int, cy: int) -> int:
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
