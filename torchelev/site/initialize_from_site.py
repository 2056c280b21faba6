"""Filling the unknown cells of maps with what a site knows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.site.fusion.entries import rise
from torchelev.site.fusion.stacks import age_stack, move_stack
from torchelev.site.fusion.windows import Contribution, move_known
from torchelev.stages.initialize import Remembered, recall
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Int

    from torchelev.elevation_map import ElevationMap

SUPPORT = 6.0  # points that must disagree before a height of the site is replaced


def move_contribution(
    contribution: Contribution, corner: Int[Tensor, "B 2"], now: float, resolution: float
) -> Contribution:
    """Return a contribution with the windows at other corners, and as of another time [s]."""
    known = move_known(contribution.known, corner)
    passed = now - known.now
    age = known.age + passed[:, None, None]
    variance = known.variance + (known.rate * passed)[:, None, None]
    known = known._replace(age=age.to(known.age), variance=variance.to(known.variance), now=known.now * 0 + now)
    alignment = contribution.alignment.of_moved((corner - contribution.known.corner) * resolution)
    stack = contribution.stack
    if stack is not None:
        stack = age_stack(move_stack(stack, corner), passed, known.rate)
    return contribution._replace(known=known, alignment=alignment, stack=stack)


def fill(
    state: MapState,
    emap: ElevationMap,
    known: Remembered,
    contribution: Contribution,
    chosen: Tensor,
    resolution: float,
) -> MapState:
    """Fill the unknown cells of the chosen environments with what a site knows, raised by how they lie above it."""
    place = torch.arange(state.elevation.numel(), device=chosen.device)
    robot = place // state.elevation[0].numel()
    above = rise(contribution.known, contribution.alignment, robot, place, resolution).view_as(known.elevation)
    before = known._replace(elevation=known.elevation + above, upper_bound=known.upper_bound + above)
    return recall(state, before, chosen, emap.cfg.fusion.max_variance, SUPPORT)


def add_filled(
    contribution: Contribution, before: MapState, after: MapState, rate: float, chosen: Bool[Tensor, "B"]
) -> Contribution:
    """Return the contribution of B maps, with the cells that a site of this variance rate filled."""
    filled, known = after.validity & ~before.validity, contribution.known

    def choose(new: Tensor, old: Tensor) -> Tensor:
        return torch.where(filled, new.to(old.dtype), old)

    return contribution._replace(
        known=known._replace(
            elevation=choose(after.elevation, known.elevation),
            variance=choose(after.variance, known.variance),
            age=choose(after.time, known.age),
            is_known=known.is_known | filled,
            rate=torch.where(chosen, rate, known.rate),
        )
    )
