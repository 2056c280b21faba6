"""How the values of points, or of painted cells, become those of a channel: the definition by tensors."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.channels.config import ChannelConfig
from torchelev.channels.state import Channel
from torchelev.ops.scatter import cell_sums, highest_per_cell

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

POINT = 1e-4  # [m^2] variance of a height that counts as one point


class GroundPoints(NamedTuple):
    """The points of an update that may lie on the ground of their cells."""

    slot: Int[Tensor, "B M"]  #: flat number of the cell; any cell where it does not count
    counts: Bool[Tensor, "B M"]  #: the point lies over a known cell, and is one that the sensor measures
    distance: Float[Tensor, "B M"]  #: [m] of its height from the cell's elevation
    variance: Float[Tensor, "B M"]  #: [m^2] of its height


def accumulate(
    x: Float[Tensor, "B M C"], points: GroundPoints, num_cells: int, cfg: ChannelConfig
) -> tuple[Float[Tensor, "B cells C"], Float[Tensor, "B cells"]]:
    """Return sum w_i x_i, or the largest x_i of a maximum, and sum w_i of each cell; a point with a NaN is left out."""
    counts = points.counts & (points.distance <= cfg.tolerance) & x.isfinite().all(-1)
    weight = POINT / points.variance if cfg.is_weighted else torch.ones_like(points.variance)
    weight = torch.where(counts, weight, 0.0)
    x = torch.where(counts[..., None], x, 0.0)
    *sums, total = cell_sums(points.slot, torch.stack([*(weight * c for c in x.unbind(-1)), weight]), num_cells)
    if cfg.kind == "maximum":
        components = torch.where(counts[..., None], x, -torch.inf).unbind(-1)
        sums = [highest_per_cell(points.slot, component, num_cells) for component in components]
    return torch.stack(sums, -1), total


def combine(
    channel: Channel, added: Float[Tensor, "B H W C"], total: Float[Tensor, "B H W"], cfg: ChannelConfig
) -> Channel:
    """Return a channel with what `accumulate` found fused into its cells; equations in `ChannelConfig`."""
    is_seen = total > 0
    v, W = channel.values.to(added.dtype), channel.weight
    is_first = (W <= 0)[..., None]
    mean = added / torch.where(is_seen, total, 1.0)[..., None]
    if cfg.is_weighted:
        new = v + (mean - v) * (total / torch.where(is_seen, W + total, 1.0))[..., None]
    elif cfg.kind == "class":
        new = v + added
    elif cfg.kind == "maximum":
        new = torch.where(is_first, added, torch.maximum(v, added))
    else:
        new = torch.where(is_first, mean, (1 - cfg.rate) * v + cfg.rate * mean)
    values = torch.where(is_seen[..., None], new.to(channel.values.dtype), channel.values)
    age = None if channel.age is None else torch.where(is_seen, 0.0, channel.age)
    return Channel(values, W + total, age)


def read(channel: Channel, cfg: ChannelConfig) -> tuple[Float[Tensor, "B *cells C"], Bool[Tensor, "B *cells"]]:
    """Return what a channel says of each cell, and where it says something."""
    known, v = channel.weight > 0, channel.values.float()
    if cfg.kind == "class":
        v = (v + cfg.prior / cfg.size) / (channel.weight[..., None] + cfg.prior)
    if cfg.kind == "feature" and cfg.normalize:
        v = torch.nn.functional.normalize(v, dim=-1)
    return v, known
