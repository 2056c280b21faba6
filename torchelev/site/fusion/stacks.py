"""All surfaces of robots' windows: what each robot knows of the levels of a site, and what of it is new."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.levels.state import SURFACE
from torchelev.levels.surfaces import SETTLED, distance
from torchelev.ops.moving import sources
from torchelev.site.fusion.windows import Contribution, Known, Windows, find_new
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.elevation_map import ElevationMap


class Stack(NamedTuple):
    """All surfaces of B windows in the robots' frames, valid where `is_known`.

    Place 0 of a cell holds its ground, as a site has it: the robot's ground, or the lowest surface that is below it.
    The other places hold the other surfaces, in no order.
    """

    corner: Int[Tensor, "B 2"]  #: cell numbers of [..., 0, 0] on the lattice
    lower: Float[Tensor, "B K H W"]  #: [m] underside
    upper: Float[Tensor, "B K H W"]  #: [m] top
    variance: Float[Tensor, "B K H W"]  #: [m^2] now
    support: Float[Tensor, "B K H W"]  #: points that measured it
    age: Float[Tensor, "B K H W"]  #: [s] since the last measurement
    is_known: Bool[Tensor, "B K H W"]  #: the surface is there
    is_open: Bool[Tensor, "B H W"]  #: the space above the ground is known to be free for at least the least gap
    #: [m] up to which the space above the ground is free; -inf: none is known, or place 0 is not the robot's ground
    free_top: Float[Tensor, "B H W"]


_OF_SURFACES = ("lower", "upper", "variance", "support", "age", "is_known")


def read_stack(emap: ElevationMap, state: MapState, known: Known) -> Stack:
    """Return the surfaces of the windows of a map, whose ground is `known`, on its device; a map may lack levels."""
    ground = (known.elevation, known.elevation, known.variance, torch.full_like(known.elevation, SETTLED), known.age)
    parts = [value[:, None].float() for value in ground]
    is_known, is_open = known.is_known[:, None], torch.zeros_like(known.is_known)
    free_top = torch.full_like(parts[0][:, 0], -torch.inf)
    if emap.levels is not None and emap.cfg.levels is not None:
        levels = emap.levels.in_windows(state._replace(corner=state.corner.to(emap.device)))
        parts = [
            torch.cat([first, getattr(levels, name).to(first)], 1) for first, name in zip(parts, SURFACE, strict=True)
        ]
        is_there = (levels.support >= emap.cfg.levels.least_support) & (levels.variance < emap.cfg.fusion.max_variance)
        is_known = torch.cat([is_known, is_there.to(is_known.device)], 1)
        is_open, free_top = levels.is_open.to(is_known.device), levels.free_top.to(free_top)
    lower, upper, variance, support, age = parts
    stack = Stack(known.corner.clone(), lower, upper, variance, support, age, is_known, is_open, free_top)
    return _from_below(stack)


def _from_below(stack: Stack) -> Stack:
    """Return surfaces whose place 0 is the lowest one, of cells whose ground, in place 0, is known."""
    has_ground = stack.is_known[:, :1]
    below = has_ground & stack.is_known & (stack.upper < stack.upper[:, :1])
    is_same = ~below.any(1)
    if not is_same.all():
        place = torch.where(below, stack.upper, torch.inf).argmin(1, keepdim=True) * ~is_same[:, None]
        order = torch.arange(stack.upper.shape[1], device=place.device)[:, None, None].expand(stack.upper.shape)
        order = torch.cat([place, order.scatter(1, place, 0)[:, 1:]], 1)
        stack = stack._replace(**{name: getattr(stack, name).gather(1, order) for name in _OF_SURFACES})
    has_others = has_ground[:, 0] & stack.is_known[:, 1:].any(1)
    free_top = torch.where(is_same, stack.free_top, -torch.inf)
    return stack._replace(is_open=has_others | (stack.is_open & is_same), free_top=free_top)


def move_stack(stack: Stack, corner: Int[Tensor, "B 2"]) -> Stack:
    """Return the surfaces of windows, moved to other corners."""
    shift = corner - stack.corner
    if not shift.any():
        return stack
    index, entering = sources(shift, *stack.upper.shape[2:])

    def moved(values: Tensor) -> Tensor:
        place = index if values.ndim == 3 else index[:, None]
        return values.flatten(-2).gather(-1, place.flatten(-2).expand(*values.shape[:-2], -1)).view(values.shape)

    values = Stack(corner.clone(), *(moved(value) for value in stack[1:]))
    return values._replace(
        is_known=values.is_known & ~entering[:, None],
        is_open=values.is_open & ~entering,
        free_top=torch.where(entering, -torch.inf, values.free_top),
    )


def age_stack(stack: Stack, passed: Float[Tensor, "B"], rate: Float[Tensor, "B"]) -> Stack:
    """Return surfaces after a time [s], in which the variance grew at a rate [m^2/s]."""
    step, growth = (value.float().view(-1, 1, 1, 1) for value in (passed, passed * rate))
    return stack._replace(age=stack.age + step, variance=stack.variance + growth)


class Change(NamedTuple):
    """The surfaces of B windows at a merge, and what they were at the merge before."""

    now: Stack  #: at this merge
    before: Stack | None  #: at the one before, in the present windows, each in the place of the surface that it is now
    is_new: Bool[Tensor, "B K H W"]  #: measured since
    gone: Stack | None  #: those before that are no more; None: there was no merge before

    @property
    def is_touched(self) -> Bool[Tensor, "B H W"]:
        """The cells in which there is something to do."""
        is_new = self.is_new.any(1)
        return is_new if self.gone is None else is_new | self.gone.is_known.any(1)


def compare(stack: Stack, contribution: Contribution | None, elapsed: Int[Tensor, "B"], min_gap: float) -> Change:
    """Return how surfaces differ from those of the same robots at their last merge, within `min_gap` [m].

    Args:
        stack: at this merge.
        contribution: of the same robots.
        elapsed: [ns] of the maps' clocks.
        min_gap: [m] within which surfaces are the same.
    """
    if contribution is None or contribution.stack is None:
        return Change(stack, None, stack.is_known, None)
    before = move_stack(contribution.stack, stack.corner)
    away = distance(stack.lower[:, :, None], stack.upper[:, :, None], before.lower[:, None], before.upper[:, None])
    away = torch.where(stack.is_known[:, :, None] & before.is_known[:, None], away, torch.inf)
    near, place = away.min(2)
    matched = before._replace(**{name: getattr(before, name).gather(1, place) for name in _OF_SURFACES})
    matched = matched._replace(is_known=matched.is_known & (near <= min_gap))
    has_changed = (stack.lower != matched.lower) | (stack.upper != matched.upper) | (stack.variance < matched.variance)
    is_new = find_new(stack.is_known, matched.is_known, has_changed, stack.age, elapsed - contribution.elapsed)
    is_gone = before.is_known & (away.amin(1) > min_gap)
    is_gone[:, 0] &= stack.is_known[:, 0]  # ground that is unknown again was not seen to be gone
    return Change(stack, matched, is_new, before._replace(is_known=is_gone))


def windows_of(windows: Windows, change: Change, resolution: float) -> Windows:
    """Return windows whose ground is that of the surfaces, the lowest ones; their cells are `resolution` [m] wide."""
    ground, known = change.now, windows.known
    is_same = known.elevation.to(ground.upper) == ground.upper[:, 0]
    contribution, before = windows.contribution, windows.before
    if contribution is not None and change.before is not None:
        moved = (change.before.corner - contribution.known.corner) * resolution
        alignment = contribution.alignment.of_moved(moved)
        before = _first(contribution.known, change.before)
        contribution = contribution._replace(known=before, alignment=alignment)
    return windows._replace(
        known=_first(known, ground),
        has_normal=windows.has_normal & is_same,
        is_new=change.is_new[:, 0].contiguous(),
        contribution=contribution,
        before=before,
    )


def _first(known: Known, stack: Stack) -> Known:
    """Return what is known of the surfaces in place 0."""
    upper, variance, age, is_known = (
        getattr(stack, name)[:, 0].contiguous() for name in ("upper", "variance", "age", "is_known")
    )
    return Known(stack.corner, upper, variance, age, is_known, known.now, known.rate)
