"""Growing regions onto their border cells, merging what lies on one plane, and leaving out what is too small."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from torchelev.planes.lattice import components, same
from torchelev.planes.sums import RegionPlanes, Surface, distances, find_runs, fit_planes, region_moments, rimmed

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray

MAX_MERGES = 20  # rounds of pairs
SETTLING = 2  # rounds, each of which moves a border by a cell


def grow(
    labels: Int[ndarray, "P"], plane: RegionPlanes, surface: Surface, reach: float, rounds: int, contested: bool
) -> Int[ndarray, "P"]:
    """Give cells at the border of regions to the region whose plane is nearest, if nearer than `reach` [m].

    One ring of cells in each round. `contested`: also cells that have a region, where a neighbour's plane is nearer.
    """
    form = plane.forms()
    stride = surface.shape[1] + 1
    cell = np.flatnonzero(labels >= 0)
    best = np.full(labels.size, reach)
    best[cell] = np.abs(distances(surface, cell, form[labels[cell]])) if contested else 0.0
    best[~surface.known] = -1.0
    labels, fresh = labels.copy(), labels >= 0
    for _ in range(rounds):
        before, taken = labels.copy(), np.zeros(labels.size, bool)
        for step in (-stride, stride, -1, 1):
            # Offers to each cell from a neighbour that changed in the last round.
            offer = np.roll(before, step)
            cell = np.flatnonzero(np.roll(fresh, step) & (offer != before) & (best > 0))
            offered = offer[cell]
            distance = np.abs(distances(surface, cell, form[offered]))
            better = distance < best[cell]
            cell = cell[better]
            labels[cell], best[cell], taken[cell] = offered[better], distance[better], True
        if not contested:
            best[taken] = 0.0
        fresh = taken
    return labels


def settle(labels: Int[ndarray, "P"], plane: RegionPlanes, surface: Surface, reach: float) -> Int[ndarray, "P"]:
    """Let cells at a border that lie on both planes, nearer than `reach` [m], go with the most cells of their windows.

    Along a crease each cell's own noise would fray the border.
    """
    form, stride = plane.forms(), surface.shape[1] + 1
    for _ in range(SETTLING):
        offers = [np.roll(labels, step) for step in (-stride, stride, -1, 1)]
        cells = [np.flatnonzero((offer != labels) & (np.minimum(offer, labels) >= 0)) for offer in offers]
        cell = np.concatenate(cells)
        offered = np.concatenate([offer[at] for offer, at in zip(offers, cells, strict=True)])
        on_both = np.abs(distances(surface, cell, form[offered])) <= reach
        cell, offered = cell[on_both], offered[on_both]
        outvoted = _majority(labels.reshape(-1, stride), cell, offered, surface.radius) > 0
        labels = labels.copy()
        labels[cell[outvoted]] = offered[outvoted]
    return labels


def _majority(
    labels: Int[ndarray, "H+1 W+1"], cell: Int[ndarray, "N"], offered: Int[ndarray, "N"], radius: int
) -> Int[ndarray, "N"]:
    """Return by how many cells the offered label leads in the window around each cell."""
    around = np.pad(labels.astype(np.int32), radius, constant_values=-1)
    stride = around.shape[1]
    row, column = np.divmod(cell, labels.shape[1])
    here = row * stride + column  # the window's first cell
    around, own, offered = around.ravel(), labels.ravel()[cell].astype(np.int32), offered.astype(np.int32)
    lead = np.zeros(len(cell), np.int16)
    for step in (i * stride + j for i in range(2 * radius + 1) for j in range(2 * radius + 1)):
        label = around[here + step]
        lead += (label == offered).view(np.int8)
        lead -= (label == own).view(np.int8)
    return lead


def merge(labels: Int[ndarray, "P"], surface: Surface, roughness: float, number: int) -> Int[ndarray, "P"]:
    """Merge neighbouring regions where the cells of each lie on the plane of both, no rougher than allowed.

    In each round those pairs that are each other's best. Returns labels, some of which no cell has.
    """
    sums = region_moments(surface, find_runs(labels), number)
    pairs = _neighbours(labels, surface.shape[1] + 1, number)
    now = np.arange(number)
    for _ in range(MAX_MERGES):
        cost = _union_roughness(sums, pairs, surface.weight)
        fits = cost <= roughness
        first, second = _best_of_both(pairs[:, fits], cost[fits], number)
        if len(first) == 0:
            break
        sums[:, first] += sums[:, second]
        into = np.arange(number)
        into[second] = first
        now, pairs = into[now], _once(into[pairs], number)
    return np.append(now, -1)[labels]


def _neighbours(labels: Int[ndarray, "P"], stride: int, number: int) -> Int[ndarray, "2 E"]:
    """Return the pairs of regions that share a side of a cell."""
    pairs = []
    for step in (1, stride):
        here, there = labels[:-step], labels[step:]
        side = np.flatnonzero((here != there) & (here >= 0) & (there >= 0))
        pairs.append(np.stack([here[side], there[side]]))
    return _once(np.concatenate(pairs, 1), number)


def _once(pairs: Int[ndarray, "2 N"], number: int) -> Int[ndarray, "2 E"]:
    """Return each pair of two different labels once, the lower first."""
    low, high = pairs.min(0), pairs.max(0)
    return np.stack(np.divmod(np.unique((low * number + high)[low != high]), max(number, 1)))


def _union_roughness(sums: Float[ndarray, "12 K"], pairs: Int[ndarray, "2 E"], weight: float) -> Float[ndarray, "E"]:
    """Return the rougher region's root mean square distance from the plane of both, for each pair [m]."""
    both = sums[:, pairs[0]] + sums[:, pairs[1]]
    a, b, c, d = fit_planes(both, None, weight).forms().T
    worst = np.zeros(pairs.shape[1])
    for member in pairs:
        n, x, y, z, xx, xy, yy, xz, yz, zz = sums[:10, member]
        square = a * a * xx + b * b * yy + c * c * zz + d * d * n
        square += 2 * (a * b * xy + a * c * xz + b * c * yz + d * (a * x + b * y + c * z))
        worst = np.maximum(worst, square / n)
    return np.sqrt(worst)


def _best_of_both(pairs: Int[ndarray, "2 E"], cost: Float[ndarray, "E"], number: int) -> Int[ndarray, "2 M"]:
    """Return the pairs each of which is the cheapest for both of its regions."""
    dearest_first = np.argsort(-np.tile(cost, 2), kind="stable")
    best = np.empty(number, np.int64)
    best[pairs.ravel()[dearest_first]] = dearest_first % max(len(cost), 1)  # the last one stays
    here = np.arange(len(cost))
    return pairs[:, (best[pairs[0]] == here) & (best[pairs[1]] == here)]


def near(labels: Int[ndarray, "P"], plane: RegionPlanes, surface: Surface, reach: float) -> Int[ndarray, "P"]:
    """Take the label from cells further than `reach` [m] from their region's plane."""
    cell = np.flatnonzero(labels >= 0)
    far = np.abs(distances(surface, cell, plane.forms()[labels[cell]])) > reach
    labels = labels.copy()
    labels[cell[far]] = -1
    return labels


def connected(labels: Int[ndarray, "P"], shape: tuple[int, int], min_cells: float) -> tuple[ndarray, ndarray]:
    """Label anew (P,) what hangs together and is large enough, and tell which label (K,) it had."""
    image = labels.reshape(shape[0] + 1, -1)[:-1, :-1]
    pieces, number = components(*same(image))
    size = np.bincount(pieces.ravel() + 1, minlength=number + 1)
    large = size >= min_cells
    large[0] = False
    was = np.empty(number + 1, np.int64)
    was[pieces.ravel() + 1] = image.ravel()
    rank = np.where(large, np.cumsum(large) - 1, -1)
    return rimmed(rank[pieces + 1], -1).ravel(), was[large]
