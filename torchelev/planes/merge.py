"""Neighbouring regions that lie on one plane become one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from torchelev.planes.region_planes import fit_planes
from torchelev.planes.sums import Surface, find_runs, region_moments

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray

_MAX_ROUNDS = 20


def merge(labels: Int[ndarray, "P"], surface: Surface, max_roughness: float, number: int) -> Int[ndarray, "P"]:
    """Merge neighbouring regions if each one's cells are at most `max_roughness` [m] from the plane of both.

    In each round the pairs that are each other's best. Some labels may be left without cells.
    """
    sums = region_moments(surface, find_runs(labels), number)
    pairs = _neighbours(labels, surface.shape[1] + 1, number)
    current = np.arange(number)
    for _ in range(_MAX_ROUNDS):
        cost = _union_roughness(sums, pairs, surface.window_moment)
        fits = cost <= max_roughness
        first, second = mutually_best(pairs[:, fits], cost[fits], number)
        if len(first) == 0:
            break
        sums[:, first] += sums[:, second]
        target = np.arange(number)
        target[second] = first
        current, pairs = target[current], _unique(target[pairs], number)
    return np.append(current, -1)[labels]


def _neighbours(labels: Int[ndarray, "P"], stride: int, number: int) -> Int[ndarray, "2 E"]:
    """Return the pairs of regions that share a cell's side."""
    pairs = []
    for step in (1, stride):
        before, after = labels[:-step], labels[step:]
        side = np.flatnonzero((before != after) & (before >= 0) & (after >= 0))
        pairs.append(np.stack([before[side], after[side]]))
    return _unique(np.concatenate(pairs, 1), number)


def _unique(pairs: Int[ndarray, "2 N"], number: int) -> Int[ndarray, "2 E"]:
    """Return each pair of two different labels once, the lower first."""
    low, high = pairs.min(0), pairs.max(0)
    return np.stack(np.divmod(np.unique((low * number + high)[low != high]), max(number, 1)))


def _union_roughness(sums: Float[ndarray, "12 K"], pairs: Int[ndarray, "2 E"], weight: float) -> Float[ndarray, "E"]:
    """Return for each pair the larger of the two regions' root mean square distances [m] from the plane of both."""
    both = sums[:, pairs[0]] + sums[:, pairs[1]]
    a, b, c, d = fit_planes(both, None, weight).distance_weights().T
    worst = np.zeros(pairs.shape[1])
    for member in pairs:
        n, x, y, z, xx, xy, yy, xz, yz, zz = sums[:10, member]
        square = a * a * xx + b * b * yy + c * c * zz + d * d * n
        square += 2 * (a * b * xy + a * c * xz + b * c * yz + d * (a * x + b * y + c * z))
        worst = np.maximum(worst, square / n)
    return np.sqrt(worst)


def mutually_best(pairs: Int[ndarray, "2 E"], cost: Float[ndarray, "E"], number: int) -> Int[ndarray, "2 M"]:
    """Return the pairs that are the cheapest for both of their regions."""
    dearest_first = np.argsort(-np.tile(cost, 2), kind="stable")
    best = np.empty(number, np.int64)
    best[pairs.ravel()[dearest_first]] = dearest_first % max(len(cost), 1)  # later assignments, the cheapest, win
    index = np.arange(len(cost))
    return pairs[:, (best[pairs[0]] == index) & (best[pairs[1]] == index)]
