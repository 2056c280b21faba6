"""Regions grow onto their border cells, borders are smoothed, and distant cells and small regions are dropped."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from torchelev.planes.lattice import components, same_label
from torchelev.planes.region_planes import RegionPlanes, distances
from torchelev.planes.sums import Surface, pad_cells

if TYPE_CHECKING:
    from jaxtyping import Int
    from numpy import ndarray

_SMOOTHING_ROUNDS = 2  # each moves a border by at most one cell


def grow(
    labels: Int[ndarray, "P"],
    plane: RegionPlanes,
    surface: Surface,
    max_distance: float,
    rounds: int,
    may_take_over: bool,
) -> Int[ndarray, "P"]:
    """Give cells next to regions to the region with the nearest plane, one ring of cells per round.

    Args:
        labels: region of each cell, -1 for none.
        plane: the regions' planes.
        surface: the map.
        max_distance: [m] of a cell from the plane that takes it.
        rounds: number of rings.
        may_take_over: whether cells may also leave a region for a neighbour whose plane is nearer.
    """
    weights = plane.distance_weights()
    stride = surface.shape[1] + 1
    cell = np.flatnonzero(labels >= 0)
    best = np.full(labels.size, max_distance)
    best[cell] = np.abs(distances(surface, cell, weights[labels[cell]])) if may_take_over else 0.0
    best[~surface.known] = -1.0
    labels, is_new = labels.copy(), labels >= 0
    for _ in range(rounds):
        before, is_taken = labels.copy(), np.zeros(labels.size, bool)
        for source, cell in _sides(before, stride):
            # Neighbours that changed in the last round offer their label.
            asked = is_new[source] & (best[cell] > 0)
            cell, offered = cell[asked], before[source[asked]]
            distance = np.abs(distances(surface, cell, weights[offered]))
            is_better = distance < best[cell]
            cell = cell[is_better]
            labels[cell], best[cell], is_taken[cell] = offered[is_better], distance[is_better], True
        if not may_take_over:
            best[is_taken] = 0.0
        is_new = is_taken
    return labels


def _sides(labels: Int[ndarray, "P"], stride: int) -> list[tuple[Int[ndarray, "N"], Int[ndarray, "N"]]]:
    """Return the pairs of neighbours of different labels: those one row down, one row up, one cell on and one back."""
    pairs = []
    for step in (stride, 1):
        first = np.flatnonzero(labels[:-step] != labels[step:])
        pairs += [(first + step, first), (first, first + step)]
    return pairs


def smooth_borders(
    labels: Int[ndarray, "P"], plane: RegionPlanes, surface: Surface, max_distance: float
) -> Int[ndarray, "P"]:
    """Give border cells that lie within `max_distance` [m] of both planes to the majority in their window.

    Along a crease the cells' own noise would otherwise fray the border.
    """
    weights, stride = plane.distance_weights(), surface.shape[1] + 1
    for _ in range(_SMOOTHING_ROUNDS):
        source, cell = (np.concatenate(ends) for ends in zip(*_sides(labels, stride), strict=True))
        is_border = np.minimum(labels[source], labels[cell]) >= 0
        cell, offered = cell[is_border], labels[source[is_border]]
        is_on_both = np.abs(distances(surface, cell, weights[offered])) <= max_distance
        cell, offered = cell[is_on_both], offered[is_on_both]
        is_outvoted = _majority(labels.reshape(-1, stride), cell, offered, surface.radius) > 0
        labels = labels.copy()
        labels[cell[is_outvoted]] = offered[is_outvoted]
    return labels


def _majority(
    labels: Int[ndarray, "H+1 W+1"], cell: Int[ndarray, "N"], offered: Int[ndarray, "N"], radius: int
) -> Int[ndarray, "N"]:
    """Return by how many cells the offered label leads the cell's own in the window around it."""
    rimmed = np.pad(labels.astype(np.int32), radius, constant_values=-1)
    stride = rimmed.shape[1]
    row, column = np.divmod(cell, labels.shape[1])
    corner = row * stride + column  # the window's first cell
    rimmed, own, offered = rimmed.ravel(), labels.ravel()[cell].astype(np.int32), offered.astype(np.int32)
    lead = np.zeros(len(cell), np.int16)
    for step in (i * stride + j for i in range(2 * radius + 1) for j in range(2 * radius + 1)):
        label = rimmed[corner + step]
        lead += (label == offered).view(np.int8)
        lead -= (label == own).view(np.int8)
    return lead


def drop_distant(
    labels: Int[ndarray, "P"], plane: RegionPlanes, surface: Surface, max_distance: float
) -> Int[ndarray, "P"]:
    """Remove the label from cells more than `max_distance` [m] from their region's plane."""
    cell = np.flatnonzero(labels >= 0)
    is_distant = np.abs(distances(surface, cell, plane.distance_weights()[labels[cell]])) > max_distance
    labels = labels.copy()
    labels[cell[is_distant]] = -1
    return labels


def relabel_components(
    labels: Int[ndarray, "P"], shape: tuple[int, int], min_cells: float
) -> tuple[Int[ndarray, "P"], Int[ndarray, "K"]]:
    """Give each connected part of at least `min_cells` its own label; also return its previous label."""
    image = labels.reshape(shape[0] + 1, -1)[:-1, :-1]
    pieces, number = components(*same_label(image))
    size = np.bincount(pieces.ravel() + 1, minlength=number + 1)
    is_large = size >= min_cells
    is_large[0] = False
    previous = np.empty(number + 1, np.int64)
    previous[pieces.ravel() + 1] = image.ravel()
    rank = np.where(is_large, np.cumsum(is_large) - 1, -1)
    return pad_cells(rank[pieces + 1], -1).ravel(), previous[is_large]
