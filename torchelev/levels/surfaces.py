"""Surfaces of cells: a new one, one more scan of one, and surfaces that meet. Layers are (B, L, cells)."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.levels.state import SURFACE, Levels

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

GATE = 3.0  # standard deviations between heights that are the same
SETTLED = 10.0  # points from which on a surface is no handful of wrong returns


class Found(NamedTuple):
    """A surface in each cell, as a scan shows it."""

    lower: Float[Tensor, "B cells"]  #: [m]
    upper: Float[Tensor, "B cells"]  #: [m]
    mean: Float[Tensor, "B cells"]  #: [m]
    variance: Float[Tensor, "B cells"]  #: [m^2] of the mean
    noise: Float[Tensor, "B cells"]  #: [m^2] of a point
    number: Float[Tensor, "B cells"]  #: of points


def distance(lower: Tensor, upper: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return the distance [m] of two intervals, 0 where they meet."""
    return torch.maximum(lower - high, low - upper).clamp(min=0)


def insert(
    levels: Levels, where: Bool[Tensor, "B cells"], found: Found, time: Tensor | float
) -> tuple[Levels, Bool[Tensor, "B cells"]]:
    """Put a surface into an empty place of each cell, else into that of the least points, if it has more.

    Returns:
        The levels, and where a surface was dropped.
    """
    support, place = levels.support.min(1)
    takes = where & ((support <= 0) | (found.number > support))
    chosen = torch.zeros_like(levels.support, dtype=torch.bool).scatter(1, place[:, None], takes[:, None])
    is_thin = found.upper - found.lower <= 2 * GATE * found.noise.sqrt()
    new = dict(
        lower=torch.where(is_thin, found.mean, found.lower),
        upper=torch.where(is_thin, found.mean, found.upper),
        variance=found.variance,
        support=found.number,
        time=torch.zeros_like(found.mean) + time,
    )
    put = {name: torch.where(chosen, new[name][:, None], getattr(levels, name)) for name in SURFACE}
    return levels._replace(**put), where & (support > 0)


def fuse(levels: Levels, where: Bool[Tensor, "B L cells"], found: Found, max_support: float) -> Levels:
    """Fuse what a scan shows into surfaces: Kalman updates of the faces that it agrees with, growth beyond them.

    A scan whose points spread no more than their noise measures the face within whose gate its mean lies, top or
    underside, or both of a thin surface (paper, eq. 1 and 2). Between the faces it changes nothing, and beyond them it
    makes the surface thicker. A scan that spreads farther shows a steep face, and stretches the surface to its ends.
    """
    low, high, mean, variance, noise, number = (value[:, None] for value in found)
    sigma = (levels.variance + noise).sqrt()
    is_flat = high - low <= 2 * GATE * noise.sqrt()
    gain = levels.variance / (levels.variance + variance)
    at_top, at_bottom = ((mean - face).abs() <= GATE * sigma for face in (levels.upper, levels.lower))
    upper = torch.where(at_top, levels.upper + gain * (mean - levels.upper), torch.maximum(levels.upper, mean))
    lower = torch.where(at_bottom, levels.lower + gain * (mean - levels.lower), torch.minimum(levels.lower, mean))
    upper = torch.where(is_flat, upper, torch.maximum(levels.upper, high))
    lower = torch.where(is_flat, lower, torch.minimum(levels.lower, low))
    measures = is_flat & (at_top | at_bottom)
    new = dict(
        lower=torch.minimum(lower, upper),
        upper=torch.maximum(lower, upper),
        variance=torch.where(measures, (1 - gain) * levels.variance, levels.variance),
        support=(levels.support + number).clamp(max=max_support),
        time=torch.zeros_like(levels.time),
    )
    return levels._replace(**{name: torch.where(where, new[name], getattr(levels, name)) for name in SURFACE})


def merge(levels: Levels) -> tuple[Levels, Bool[Tensor, "B L cells"]]:
    """Make one of surfaces of a cell that meet; return the levels, and which places became empty."""
    parts = {name: list(getattr(levels, name).unbind(1)) for name in SURFACE}
    lower, upper, variance, support, time = (parts[name] for name in SURFACE)
    gone = [torch.zeros_like(lower[0], dtype=torch.bool) for _ in lower]
    for a in range(len(lower)):
        for b in range(a + 1, len(lower)):
            meet = (support[a] > 0) & (support[b] > 0) & (distance(lower[a], upper[a], lower[b], upper[b]) <= 0)
            lower[a] = torch.where(meet, torch.minimum(lower[a], lower[b]), lower[a])
            upper[a] = torch.where(meet, torch.maximum(upper[a], upper[b]), upper[a])
            variance[a] = torch.where(meet, torch.minimum(variance[a], variance[b]), variance[a])
            support[a] = torch.where(meet, torch.maximum(support[a], support[b]), support[a])
            time[a] = torch.where(meet, torch.minimum(time[a], time[b]), time[a])
            support[b], gone[b] = torch.where(meet, 0.0, support[b]), gone[b] | meet
    return levels._replace(**{name: torch.stack(parts[name], 1) for name in SURFACE}), torch.stack(gone, 1)
