"""The points of a scan in each cell, from below: clusters between which there is a gap."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class Clusters(NamedTuple):
    """Clusters of points, at most as many as there are points: those that do not exist have the slot `num_cells`."""

    slot: Int[Tensor, "B M"]  #: flat number of the cell
    rank: Int[Tensor, "B M"]  #: from below, among the clusters of the cell
    lower: Float[Tensor, "B M"]  #: [m] of the lowest point
    upper: Float[Tensor, "B M"]  #: [m] of the highest point
    mean: Float[Tensor, "B M"]  #: [m] weighted by 1 / sigma^2
    weight: Float[Tensor, "B M"]  #: [1/m^2] sum of 1 / sigma^2
    number: Float[Tensor, "B M"]  #: of points
    above_ramp: Bool[Tensor, "B M"]  #: all of them lie above the exclusion ramp
    of_point: Int[Tensor, "B M"]  #: number of the cluster of each point


def find_clusters(
    z: Float[Tensor, "B M"],
    variance: Float[Tensor, "B M"],
    slot: Int[Tensor, "B M"],
    counts: Bool[Tensor, "B M"],
    above_ramp: Bool[Tensor, "B M"],
    num_cells: int,
    min_gap: float,
) -> Clusters:
    """Cut the points of each cell, in the order of heights, where two of them are more than `min_gap` [m] apart."""
    slot, z = torch.where(counts, slot, num_cells), torch.where(counts, z, 0.0)
    order = z.argsort(stable=True, dim=1)
    order = order.gather(1, slot.gather(1, order).argsort(stable=True, dim=1))
    slot, z, w, ramp = (value.gather(1, order) for value in (slot, z, 1 / variance, above_ramp))
    begins = torch.ones_like(slot, dtype=torch.bool)
    begins[:, 1:] = (slot[:, 1:] != slot[:, :-1]) | (z[:, 1:] - z[:, :-1] > min_gap)
    index = begins.to(torch.int64).cumsum(1) - 1
    blank = torch.full_like(z, torch.inf)
    lower = blank.scatter_reduce(1, index, z, "amin")
    weight, number, lift = (
        torch.zeros_like(z).scatter_add(1, index, value)
        for value in (w, torch.ones_like(z), w * (z - lower.gather(1, index)))
    )
    slots = torch.full_like(slot, num_cells).scatter(1, index, slot)
    first = torch.full_like(slot, len(slot[0]))[:, :1].expand(-1, num_cells + 1)
    first = first.scatter_reduce(1, slot, index, "amin")
    count = torch.arange(slot.shape[1], device=slot.device).expand_as(slot)
    return Clusters(
        slot=slots,
        rank=count - first.gather(1, slots),
        lower=lower,
        upper=(-blank).scatter_reduce(1, index, z, "amax"),
        mean=lower + lift / torch.where(weight > 0, weight, 1.0),
        weight=weight,
        number=number,
        above_ramp=torch.ones_like(slot).scatter_reduce(1, index, ramp.to(torch.int64), "amin") > 0,
        of_point=torch.empty_like(index).scatter(1, order, index),
    )


def in_cells(values: Tensor, clusters: Clusters, rank: int, num_cells: int, blank: float) -> Tensor:
    """Return the values (B, M) of the clusters of a rank by cell, (B, cells)."""
    slot = torch.where(clusters.rank == rank, clusters.slot, num_cells)
    table = values.new_full((len(values), num_cells + 1), blank)
    return table.scatter(1, slot, values)[:, :num_cells]
