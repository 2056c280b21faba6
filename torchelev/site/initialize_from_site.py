"""Filling the unknown cells of maps with what a site knows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.site.fusion.entries import rise
from torchelev.site.fusion.stacks import age_stack, move_stack
from torchelev.site.fusion.windows import Contribution, move_known
from torchelev.stages.initialize import Remembered, recall
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.elevation_map import ElevationMap
    from torchelev.site.content.reading import Clock

SUPPORT = 6.0  # points that must disagree before a height of the site is replaced


class Filled(NamedTuple):
    """B maps with what a site knows in their unknown cells."""

    state: MapState  #: of the maps
    contribution: Contribution  #: with the filled cells, which the site has already


def fill_windows(
    state: MapState,
    emap: ElevationMap,
    known: Remembered,
    contribution: Contribution,
    chosen: Bool[Tensor, "B"],
    clock: Clock,
    resolution: float,
) -> Filled:
    """Fill the unknown cells of the chosen environments with what a site knows.

    Args:
        state: of the maps, with the windows where they will be.
        emap: the map, for its settings.
        known: what the site knows of these windows, NaN elsewhere.
        contribution: of the maps, wherever their windows were then.
        chosen: environments to fill.
        clock: of the site.
        resolution: [m].
    """
    contribution = _move(contribution, state.corner, clock.time, resolution)
    after = _fill(state, emap, known, contribution, chosen, resolution)
    return Filled(after, _add_filled(contribution, state, after, clock.rate, chosen))


def spread(layers: Mapping[str, Tensor], ids: Int[Tensor, "K"], like: Float[Tensor, "B H W"]) -> Remembered:
    """Return what a site knows of K of B windows as that of all windows, NaN of the others; no layers: of none."""
    unknown = torch.full(like.shape, torch.nan, device=like.device)
    return Remembered(*(unknown.index_copy(0, ids, layers[n]) if layers else unknown for n in Remembered._fields))


def _move(contribution: Contribution, corner: Int[Tensor, "B 2"], now: float, resolution: float) -> Contribution:
    """Return a contribution with the windows at other corners, as of another time [s]."""
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


def _fill(
    state: MapState,
    emap: ElevationMap,
    known: Remembered,
    contribution: Contribution,
    chosen: Bool[Tensor, "B"],
    resolution: float,
) -> MapState:
    """Return the filled state: what the site knows, raised by the offset of each map above it."""
    place = torch.arange(state.elevation.numel(), device=chosen.device)
    robot = place // state.elevation[0].numel()
    above = rise(contribution.known, contribution.alignment, robot, place, resolution).view_as(known.elevation)
    before = known._replace(elevation=known.elevation + above, upper_bound=known.upper_bound + above)
    return recall(state, before, chosen, emap.cfg.fusion.max_variance, SUPPORT)


def _add_filled(
    contribution: Contribution, before: MapState, after: MapState, rate: float, chosen: Bool[Tensor, "B"]
) -> Contribution:
    """Return a contribution with the cells that a site of this variance rate filled."""
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
