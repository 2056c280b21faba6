"""What levels hold, and how they follow the window of the map."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.ops.moving import move_layers

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class Levels(NamedTuple):
    """The surfaces of B maps besides the ground, L = K - 1 places in each cell in no order, and the space above it.

    `MapLevels` stores them in rings: row k of the map frame's lattice at k modulo H, columns alike, so that cells stay
    where they are when the window moves.
    """

    lower: Float[Tensor, "B L H W"]  #: [m] underside, map frame
    upper: Float[Tensor, "B L H W"]  #: [m] top, map frame
    variance: Float[Tensor, "B L H W"]  #: [m^2] of either height
    support: Float[Tensor, "B L H W"]  #: points that measured it; 0: the place is empty
    time: Float[Tensor, "B L H W"]  #: [s] since the last of them
    free_top: Float[Tensor, "B H W"]  #: [m] up to which rays showed that the space above the ground is free; -inf: none
    is_open: Bool[Tensor, "B H W"]  #: rays passed close above the ground, and higher by `min_gap`: it is no wall's foot


class LevelStatistics(NamedTuple):
    """What the last update did to levels, (B,) int64."""

    opened: Int[Tensor, "B"]  #: surfaces found
    cleared: Int[Tensor, "B"]  #: surfaces that rays passed through
    merged: Int[Tensor, "B"]  #: surfaces that met another one
    dropped: Int[Tensor, "B"]  #: surfaces for which a cell had no place: those with the fewest points
    chosen: Int[Tensor, "B"]  #: cells whose ground became another surface


SURFACE = Levels._fields[:5]


def blank_levels(size: tuple[int, int, int, int], device: torch.device | str) -> Levels:
    """Return levels of which nothing is known; `size` is (B, L, H, W)."""
    zero = torch.zeros(size, device=device)
    free_top = torch.full((size[0], *size[2:]), -torch.inf, device=device)
    is_open = torch.zeros_like(free_top, dtype=torch.bool)
    return Levels(**{name: zero.clone() for name in SURFACE}, free_top=free_top, is_open=is_open)


def move(levels: Levels, shift: Int[Tensor, "B 2"]) -> Levels:
    """Return levels whose windows moved by whole cells; entering cells are blank."""
    shift = shift.clamp(-max(levels.lower.shape[2:]), max(levels.lower.shape[2:]))
    layers = {f"{name}{k}": part for name in SURFACE for k, part in enumerate(getattr(levels, name).unbind(1))}
    space = {"free_top": levels.free_top, "is_open": levels.is_open}
    moved = move_layers(layers | space, shift, {"free_top": -torch.inf})
    L = levels.lower.shape[1]
    parts = {name: torch.stack([moved[f"{name}{k}"] for k in range(L)], 1) for name in SURFACE}
    return Levels(**parts, **{name: moved[name] for name in space})


def turn(levels: Levels, corner: Int[Tensor, "B 2"], to_ring: bool) -> Levels:
    """Return levels in the order of a window with this corner as rings, or rings in the order of the window."""
    B, _, H, W = levels.lower.shape
    i = torch.arange(H, device=corner.device) + corner[:, :1]
    j = torch.arange(W, device=corner.device) + corner[:, 1:]
    place = (i % H)[:, :, None] * W + (j % W)[:, None, :]
    if to_ring:
        cells = torch.arange(H * W, device=corner.device).expand(B, -1)
        place = torch.empty_like(cells).scatter(1, place.flatten(1), cells)

    def turned(values: Tensor) -> Tensor:
        flat = values.flatten(-2)
        index = place.flatten(1) if flat.ndim == 2 else place.flatten(1)[:, None].expand(flat.shape)
        return flat.gather(-1, index).view(values.shape)

    return Levels(*(turned(values) for values in levels))


def age(levels: Levels, dt: Float[Tensor, "B"], variance_rate: float, max_variance: float) -> Levels:
    """Return levels after a time [s], sigma^2 += rate * dt."""
    step, is_there = dt[:, None, None, None], levels.support > 0
    variance = (levels.variance + variance_rate * step).clamp(max=max_variance)
    return levels._replace(
        variance=torch.where(is_there, variance, levels.variance),
        time=torch.where(is_there, levels.time + step, levels.time),
    )


def raise_surfaces(levels: Levels, height: Float[Tensor, "B"]) -> Levels:
    """Return levels raised by a height [m] of each map, as drift compensation raises the ground."""
    step = torch.where(levels.support > 0, height[:, None, None, None], 0.0)
    free_top = levels.free_top + height[:, None, None]
    return levels._replace(lower=levels.lower + step, upper=levels.upper + step, free_top=free_top)


def forget_space(levels: Levels, cells: Tensor) -> Levels:
    """Return levels without what rays showed of the space over some cells, (B, H, W) bool."""
    free_top = torch.where(cells, -torch.inf, levels.free_top)
    return levels._replace(free_top=free_top, is_open=levels.is_open & ~cells)


def remove(levels: Levels, gone: Tensor) -> Levels:
    """Return levels without some surfaces, (B, L, H, W) bool."""
    return levels._replace(**{name: torch.where(gone, 0.0, getattr(levels, name)) for name in SURFACE})
