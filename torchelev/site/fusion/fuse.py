"""Fusing the heights of windows into cells: those that agree are averaged, others kept apart."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.site.site_config import SiteConfig

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


_ALONE = 1e-6  # share of a cell's information, below which the other heights are ignored


class Heights(NamedTuple):
    """Heights in the site's frame. Variances are those right after the last measurement."""

    elevation: Float[Tensor, "C"]  #: [m]
    variance: Float[Tensor, "C"]  #: [m^2]
    time: Float[Tensor, "C"]  #: [s] of the last measurement, NaN where unknown

    @property
    def known(self) -> Bool[Tensor, "C"]:
        """Which of them are known."""
        return self.time == self.time  # NaN is not; a third of the time of isfinite

    def at(self, cells: Tensor) -> Heights:
        """Return the ones with these numbers."""
        return Heights(*(value.index_select(0, cells) for value in self))

    def where(self, mask: Tensor, others: Heights) -> Heights:
        """Return these where the mask is true, and the others elsewhere."""
        return Heights(*(torch.where(mask, a, b) for a, b in zip(self, others, strict=True)))

    def information(self, time: Tensor, rate: float) -> Float[Tensor, "C"]:
        """Return 1 / variance [1/m^2] at a later time, 0 where unknown; the variance grows at a rate [m^2/s]."""
        return (1.0 / (self.variance + rate * (time - self.time))).nan_to_num(nan=0.0)


class Entries(NamedTuple):
    """K heights of cells."""

    cell: Int[Tensor, "K"]  #: number of the cell
    heights: Heights  #: (K,) each
    relief: Float[Tensor, "K"]  #: [m^2] variance of heights within the cell
    contributed: Heights | None  #: earlier contributions of the same robots, which these replace; None: none

    def select(self, chosen: Int[Tensor, "k"], number: Int[Tensor, "C"]) -> Entries:
        """Return some of them, whose cells get new numbers."""
        cell, relief = self.cell.index_select(0, chosen), self.relief.index_select(0, chosen)
        contributed = None if self.contributed is None else self.contributed.at(chosen)
        return Entries(number.index_select(0, cell), self.heights.at(chosen), relief, contributed)


class Fused(NamedTuple):
    """C cells after a fusion."""

    first: Heights  #: the site's height
    other: Heights  #: the height that contradicts it
    is_contradicted: Bool[Tensor, "K"]  #: entries of cells in which heights contradict each other


def fuse(first: Heights, other: Heights, entries: Entries, rate: float, cfg: SiteConfig) -> Fused:
    """Fuse entries into cells. The result does not depend on the order of the entries, up to rounding.

    Where every height of a cell, the site's included, lies within the gate of the mean of the others, the mean of all
    is the cell's new height. Elsewhere the surest height is the reference: what lies within the gate of it is averaged,
    the rest forms the cell's other height in the same way, and what agrees with neither is dropped.

    Args:
        first: what the site says of the cells.
        other: what contradicts it.
        entries: what the windows say.
        rate: [m^2/s] sigma_t^2, the process noise (paper, Sec. II-C).
        cfg: settings.
    """
    scale = _weigh(first, entries, rate)
    agrees, is_kept = _agree_with_others(first, entries, scale, cfg)
    fused = _average(first, entries, scale, scale.mean, agrees, is_kept, rate, cfg)
    mask = ((first.known & ~is_kept) & (scale.total > scale.own)).index_fill_(0, entries.cell[~agrees], True)
    cells = mask.nonzero()[:, 0]
    if not len(cells):
        return Fused(fused, other, ~agrees)
    number = torch.zeros_like(mask, dtype=torch.int64)
    number[cells] = torch.arange(len(cells), device=cells.device)
    is_contradicted = mask.index_select(0, entries.cell)
    contested = entries.select(is_contradicted.nonzero()[:, 0], number)
    resolved = _resolve(first.at(cells), other.at(cells), contested, rate, cfg)
    fused, other = (
        Heights(*(value.index_copy(0, cells, part) for value, part in zip(all_, parts, strict=True)))
        for all_, parts in zip((fused, other), resolved, strict=True)
    )
    return Fused(fused, other, is_contradicted)


def _resolve(first: Heights, other: Heights, entries: Entries, rate: float, cfg: SiteConfig) -> tuple[Heights, Heights]:
    """Return the heights of cells whose heights contradict each other: the site's, and the other one."""
    fused, agrees, is_kept = _average_near_surest(first, entries, rate, cfg)
    lost = (first.known & ~is_kept).nonzero()[:, 0]
    same = torch.arange(len(first.time), device=lost.device)
    rest, site = entries.select((~agrees).nonzero()[:, 0], same), first.at(lost)
    heights = Heights(*(torch.cat(pair) for pair in zip(rest.heights, site, strict=True)))
    relief = torch.cat([rest.relief, torch.zeros_like(site.time)])
    nothing = Heights(*[torch.full_like(site.time, torch.nan)] * 3)
    contributed = (
        None
        if rest.contributed is None
        else Heights(*(torch.cat(pair) for pair in zip(rest.contributed, nothing, strict=True)))
    )
    rest_of_all = Entries(torch.cat([rest.cell, lost]), heights, relief, contributed)
    second, _, _ = _average_near_surest(other, rest_of_all, rate, cfg, among_entries=True)
    nowhere, ours = torch.zeros_like(is_kept), entries.cell[agrees]
    holds_new = nowhere.index_fill(0, ours, True), nowhere.index_fill(0, rest.cell, True)
    wins = _replaces(second, fused, holds_new, rate, cfg)
    return second.where(wins, fused), fused.where(wins, second)


class _Weights(NamedTuple):
    """The information [1/m^2] of heights, at the time of the newest measurement of their cell."""

    newest: Float[Tensor, "C"]  # [s]
    own: Float[Tensor, "C"]  # of the cell before
    new: Float[Tensor, "K"]  # of the entries
    total: Float[Tensor, "C"]
    mean: Float[Tensor, "C"]  # [m] of all heights


def _weigh(prior: Heights, entries: Entries, rate: float) -> _Weights:
    cell = entries.cell
    newest = prior.time.nan_to_num(nan=-torch.inf).scatter_reduce(0, cell, entries.heights.time, "amax")
    own, new = prior.information(newest, rate), entries.heights.information(newest.index_select(0, cell), rate)
    total = own.scatter_add(0, cell, new)
    # About one of the heights, so that float32 keeps millimetres at any altitude.
    about = prior.elevation.nan_to_num(nan=0.0)
    about = torch.where(own > 0, about, about.scatter(0, cell, entries.heights.elevation))
    moment = torch.zeros_like(own).scatter_add_(
        0, cell, new * (entries.heights.elevation - about.index_select(0, cell))
    )
    return _Weights(newest, own, new, total, about + moment / total)


def _average_near_surest(
    prior: Heights, entries: Entries, rate: float, cfg: SiteConfig, among_entries: bool = False
) -> tuple[Heights, Tensor, Tensor]:
    """Average the heights that agree with each cell's surest one; return which entries (K,) and priors (C,) do.

    With `among_entries`, the surest one is an entry, where there is one.
    """
    weights = _weigh(prior, entries, rate)
    own = weights.own.index_fill(0, entries.cell, 0.0) if among_entries else weights.own
    best = own.scatter_reduce(0, entries.cell, weights.new, "amax")
    reference = _find_surest(prior, entries, weights._replace(own=own), best)
    distance = (h - r for h, r in _pair(prior.elevation, entries, reference, entries.heights.elevation))
    variance = (1 / w + 1 / b for w, b in _pair(weights.own, entries, best, weights.new))
    agrees, is_kept = _pass_gate(prior, entries, [*distance], [*variance], cfg)
    return _average(prior, entries, weights, reference, agrees, is_kept, rate, cfg), agrees, is_kept


def _pair(of_priors: Tensor, entries: Entries, of_cells: Tensor, of_entries: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Return the values of the entries, and of the priors, each with that of its cell."""
    return [(of_entries, of_cells.index_select(0, entries.cell)), (of_priors, of_cells)]


def _find_surest(prior: Heights, entries: Entries, weights: _Weights, best: Tensor) -> Float[Tensor, "C"]:
    """Return the height of the largest information; of several, the one nearest to the mean, and then the lowest.

    Distances count in millimetres, so that rounding does not choose between two that are equally far.
    """
    cell, heights = entries.cell, entries.heights.elevation
    is_best = weights.new >= best.index_select(0, cell), weights.own >= best
    from_mean = (heights - weights.mean.index_select(0, cell)).abs(), (prior.elevation - weights.mean).abs()
    far = [
        torch.where(mask, (1e3 * distance).round(), torch.inf)
        for mask, distance in zip(is_best, from_mean, strict=True)
    ]
    nearest = far[1].nan_to_num(nan=torch.inf).scatter_reduce(0, cell, far[0], "amin")
    own = torch.where(far[1] <= nearest, prior.elevation, torch.inf)
    return own.scatter_reduce(0, cell, torch.where(far[0] <= nearest.index_select(0, cell), heights, torch.inf), "amin")


def _agree_with_others(
    prior: Heights, entries: Entries, weights: _Weights, cfg: SiteConfig
) -> tuple[Bool[Tensor, "K"], Bool[Tensor, "C"]]:
    """Return which entries, and which priors, lie within the gate of the mean of the other heights of their cell.

    With the mean m of all, whose information is W, the mean of all but the height h of information w lies
    (h - m) W / (W - w) away from it.
    """
    distance, variance = [], []
    heights = _pair(prior.elevation, entries, weights.mean, entries.heights.elevation)
    informations = _pair(weights.own, entries, weights.total, weights.new)
    for (h, mean), (w, total) in zip(heights, informations, strict=True):
        others = (total - w).clamp(min=_ALONE * total)  # of a height that is alone, the distance is 0
        distance.append((h - mean) * (total / others))
        variance.append(1 / w + 1 / others)
    return _pass_gate(prior, entries, distance, variance, cfg)


def _pass_gate(
    prior: Heights, entries: Entries, distance: list[Tensor], variance: list[Tensor], cfg: SiteConfig
) -> tuple[Bool[Tensor, "K"], Bool[Tensor, "C"]]:
    """Return which entries, and which priors, have a distance [m] within the gate, given its variance [m^2]."""
    limits = [v.clamp(max=cfg.max_gate_std**2) for v in variance]
    agrees = distance[0].square() <= cfg.gate**2 * (limits[0] + entries.relief)
    is_kept = prior.known
    if is_kept.any():
        relief = torch.zeros_like(limits[1]).scatter_reduce_(0, entries.cell, entries.relief, "amax")
        is_kept = is_kept & (distance[1].square() <= cfg.gate**2 * (limits[1] + relief))
    return agrees, is_kept


def _average(
    prior: Heights,
    entries: Entries,
    weights: _Weights,
    reference: Tensor,
    agrees: Tensor,
    is_kept: Tensor,
    rate: float,
    cfg: SiteConfig,
) -> Heights:
    """Average the entries and priors that agree, by the information form of the paper's eq. 1 and 2.

    With the information 1 / sigma^2 of all at the time of the cell's newest measurement:

        1 / sigma^2 <- 1 / sigma^2 + sum (1 / sigma_k^2 - 1 / sigma_c^2),
        h <- sigma^2 (h / sigma^2 + sum (h_k / sigma_k^2 - h_c / sigma_c^2)),

    where h_c is the same robot's earlier contribution: what it knows now replaces it, and counts once.
    """
    cell, heights, own = entries.cell, entries.heights, weights.own
    all_agree = bool(agrees.all())
    new = weights.new if all_agree else torch.where(agrees, weights.new, 0.0)
    added = torch.zeros_like(own).scatter_add_(0, cell, new)
    moment = new * (heights.elevation - reference.index_select(0, cell))
    moment = torch.zeros_like(own).scatter_add_(0, cell, moment)
    is_touched, newest = added > 0, weights.newest
    if is_kept.any():
        added = added + torch.where(is_kept, own, 0.0)
        moment = moment + torch.where(is_kept, own * (prior.elevation - reference), 0.0)
        if entries.contributed is not None:
            counts = agrees & is_kept.index_select(0, cell)
            contributed, contributed_moment = _sum_contributed(prior, entries, weights, reference, counts, rate, cfg)
            added, moment = added - contributed, moment - contributed_moment
    if not all_agree or not (is_kept | ~is_touched | ~prior.known).all():
        newest = torch.where(is_kept, prior.time, -torch.inf)
        newest = newest.scatter_reduce(0, cell, torch.where(agrees, heights.time, -torch.inf), "amax")
    return Heights(reference + moment / added, 1.0 / added, newest).where(is_touched, prior)


def _sum_contributed(
    prior: Heights, entries: Entries, weights: _Weights, reference: Tensor, counts: Tensor, rate: float, cfg: SiteConfig
) -> tuple[Float[Tensor, "C"], Float[Tensor, "C"]]:
    """Return the information of earlier contributions to the prior, and its moment about the reference, per cell.

    At most a robot's present information is taken out: after a reset it knows less than it contributed.
    """
    cell, contributed = entries.cell, entries.contributed
    assert contributed is not None
    information = contributed.information(weights.newest.index_select(0, cell), rate)
    from_prior = contributed.elevation - prior.elevation.index_select(0, cell)
    holds = counts & (from_prior.square() <= cfg.gate**2 * (cfg.max_gate_std**2 + entries.relief))
    height = torch.where(information >= weights.new, entries.heights.elevation, contributed.elevation)
    information = torch.where(holds, torch.minimum(information, weights.new), 0.0)
    moment = torch.where(holds, information * (height - reference.index_select(0, cell)), 0.0)
    nothing = torch.zeros_like(reference)
    return nothing.scatter_add(0, cell, information), nothing.scatter_add(0, cell, moment)


def _replaces(
    other: Heights, first: Heights, holds_new: tuple[Tensor, Tensor], rate: float, cfg: SiteConfig
) -> Bool[Tensor, "C"]:
    """Return where the other height replaces the site's: newer and about as sure, or as new and surer.

    Between equal times, `holds_new` decides: where the first and the other hold what was merged just now.
    """
    newest = torch.maximum(other.time, first.time)
    ratio = first.information(newest, rate) / other.information(newest, rate)
    is_tie, (first_is_new, other_is_new) = other.time == first.time, holds_new
    is_newer = (other.time > first.time) | (is_tie & other_is_new & ~first_is_new)
    is_older = (other.time < first.time) | (is_tie & first_is_new & ~other_is_new)
    limit = torch.where(is_newer, cfg.max_newer_ratio, 1.0)
    limit = torch.where(is_older, 1.0 / cfg.max_newer_ratio, limit)
    return other.known & (ratio < limit)
