"""Offsets: how much each robot's heights lie above the site's, from the ground that they have in common."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.site.fusion.compare import Pairs, ReadSite, Robots, find_pairs, gather_robots
from torchelev.site.fusion.exchange import ALONE, Exchange
from torchelev.site.fusion.normal_equations import Edges, solve
from torchelev.site.fusion.windows import Alignment, Windows
from torchelev.site.site_config import SiteConfig

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_ROUNDS = 8  # of reweighting
_WIDEST = 0.5  # [m] scale of the first round; it halves until it is the noise
_CONVERGED = 1e-6  # [m]
_BINS = range(103 << 10, 135 << 10)  # of float32 >> 13: 1,024 for each octave from 2^-24 to 2^8


def align(
    windows: Windows,
    read_site: ReadSite,
    resolution: float,
    cfg: SiteConfig,
    with_tilt: bool,
    max_difference: float = math.inf,
    exchange: Exchange = ALONE,
) -> Alignment:
    """Find the offsets by robust least squares over all pairs of overlapping windows, and of windows and the site.

    Minimises the sum of rho((h_a - o_a) - (h_b - o_b)) over the cells that are flat and certain in both, with o = 0 for
    the site. Windows that overlap each other but not the site keep the mean of their last offsets, or 0. rho is that
    of Geman and McClure, made narrower from round to round, so that moved objects do not count.

    Of several ranks, each compares the heights of its own tiles, and all solve for the offsets of all windows.

    Args:
        windows: B windows.
        read_site: returns the site's elevation, NaN where unknown, and variance at cells.
        resolution: [m].
        cfg: settings.
        with_tilt: also find how the windows tilt.
        max_difference: [m] beyond which heights, less the last offsets, are those of different levels.
        exchange: with other ranks.

    Returns:
        How this rank's windows lie.
    """
    robots, size = gather_robots(windows, exchange), 3 if with_tilt else 1
    N, own = len(robots.corner), slice(robots.first, robots.first + len(windows.known.corner))
    find = find_pairs(windows, robots, read_site, resolution, cfg, with_tilt, max_difference, exchange)
    pairs, overlap, number = _count_overlaps(find, N, cfg.min_overlap, exchange)
    unknowns = _solve(pairs, overlap, number, robots, size, exchange)[own]
    tilt = unknowns[:, 1:] if with_tilt else unknowns.new_zeros(len(unknowns), 2)
    return Alignment(unknowns[:, 0], tilt, ~overlap[own].any(1))


def _count_overlaps(
    find: Callable[[], Pairs], N: int, min_overlap: int, exchange: Exchange
) -> tuple[Pairs, Bool[Tensor, "M M"], int]:
    """Return the pairs of heights where windows overlap far enough, where they do, and how many all ranks have."""
    found: list[Pairs] = []

    def count() -> Int[Tensor, "U 2"]:
        pairs = find()
        found.append(pairs)
        numbers = torch.bincount(pairs.first * (N + 1) + pairs.second, minlength=(N + 1) ** 2)
        edges = numbers.nonzero()[:, 0]
        return torch.stack([edges, numbers[edges]], 1)

    edges, numbers = torch.cat(exchange.gather(count)).unbind(1)
    total = numbers.new_zeros((N + 1) ** 2).index_add_(0, edges, numbers).view(N + 1, N + 1)
    overlap = total + total.T >= min_overlap
    pairs = found[0]
    chosen = overlap.view(-1).index_select(0, pairs.first * (N + 1) + pairs.second)
    return pairs if chosen.all() else pairs.select(chosen.nonzero()[:, 0]), overlap, int(total[overlap].sum())


def find_groups(overlap: Bool[Tensor, "M M"]) -> Int[Tensor, "M"]:
    """Return for each window, and the site, the lowest number that it is connected with through overlaps."""
    lowest = torch.arange(len(overlap), device=overlap.device)
    a, b = overlap.nonzero().unbind(1)
    while True:
        near = lowest.scatter_reduce(0, a, lowest[b], "amin")
        near = near[near]  # also takes over the result of the lowest one: halves the chains
        if torch.equal(near, lowest):
            return lowest
        lowest = near


def _solve(
    pairs: Pairs, overlap: Bool[Tensor, "M M"], number: int, robots: Robots, size: int, exchange: Exchange
) -> Float[Tensor, "M size"]:
    """Return the offsets and tilts by iteratively reweighted least squares, float64.

    The mean offset of a group that the site does not fix stays what it was, or is 0.
    """
    N = len(overlap)
    edges, edge = _number_edges(pairs, overlap)
    groups = find_groups(overlap)
    unknowns, scale = pairs.difference.new_zeros(N, size), _WIDEST
    for _ in range(_ROUNDS if len(edges.ends) else 0):
        last = unknowns
        residual = _residuals(pairs, edge, edges, unknowns)
        noise = 1.4826 * find_median(residual, number, exchange)
        scale = max(noise, scale / 2)
        moments = _sum_moments(_weigh(residual, pairs.variance, noise, scale), pairs, edge, len(edges.ends), size)
        unknowns = solve(edges, exchange.sum(moments), groups, robots.before, last)
        if scale == noise and (unknowns - last).abs().max() < _CONVERGED:
            break
    if not len(edges.ends):
        unknowns[:-1, 0] = robots.before.nan_to_num(nan=0.0)
    return unknowns[:-1]


def _number_edges(pairs: Pairs, overlap: Bool[Tensor, "M M"]) -> tuple[Edges, Int[Tensor, "P"]]:
    """Return the pairs of windows that overlap, of all ranks, and which one each pair of heights belongs to."""
    N = len(overlap)
    ends = overlap.triu(1).nonzero()
    number = torch.zeros(N * N, dtype=torch.int64, device=ends.device)
    flat = ends[:, 0] * N + ends[:, 1]
    number[flat] = torch.arange(len(ends), device=ends.device)
    return Edges(ends, N), number.index_select(0, pairs.first * N + pairs.second)


def _residuals(pairs: Pairs, edge: Tensor, edges: Edges, unknowns: Tensor) -> Float[Tensor, "P"]:
    """Return what the offsets and tilts leave of the differences [m]."""
    terms = edges.factors(unknowns)
    residual = pairs.difference - terms[0].index_select(0, edge)
    if pairs.position is not None:
        for column, term in zip(pairs.position, terms[1:], strict=True):
            residual -= column * term.index_select(0, edge)
    return residual


def _weigh(residual: Tensor, variance: Tensor, noise: float, scale: float) -> Float[Tensor, "P"]:
    """Return the weights [1/m^2] by Geman and McClure: 1 / (variance (1 + r^2 / (9 max(variance, scale^2)))^2)."""
    variance = variance.clamp(min=noise**2)
    width = variance.clamp(min=scale**2).mul_(9)
    weight = residual.square().div_(width).add_(1).square_().mul_(variance)
    return weight.reciprocal_()


def find_median(values: Float[Tensor, "P"], number: int, exchange: Exchange) -> float:
    """Return the median of the magnitudes of `number` values of all ranks, to 1 in 1,000 where they are few [m].

    Counts them in bins, which ranks can add up, and interpolates in the bin of the median.
    """
    bins = values.float().abs_().view(torch.int32) >> 13
    counts = torch.bincount(bins.clamp_(_BINS.start, _BINS.stop - 1).sub_(_BINS.start), minlength=len(_BINS))
    below = exchange.sum(counts.to(torch.int32)).cumsum(0)
    rank = (number - 1) // 2
    place = int(torch.searchsorted(below, rank, right=True))
    if place == 0:
        return 0.0
    before = int(below[place - 1])
    low, high = (torch.tensor([place, place + 1], dtype=torch.int32) + _BINS.start << 13).view(torch.float32).tolist()
    return low + (high - low) * (rank - before + 0.5) / (int(below[place]) - before)


def _sum_moments(weight: Tensor, pairs: Pairs, edge: Tensor, num_edges: int, size: int) -> Float[Tensor, "U m m+1"]:
    """Return the weighted sums of all products of columns with columns, and with the difference, per edge."""
    columns = [None] if pairs.position is None else [None, *pairs.position.double()]
    m = len(columns)
    total = weight.new_zeros(num_edges, m, m + 1)
    for i, column in enumerate(columns):
        weighted = weight if column is None else weight * column
        for j, factor in enumerate((*columns[: i + 1], pairs.difference)):
            place = j if j <= i else m
            product = weighted if factor is None else weighted * factor
            total[:, i, place] = weight.new_zeros(num_edges).scatter_add_(0, edge, product)
            if j < i:
                total[:, j, i] = total[:, i, j]
    return total
