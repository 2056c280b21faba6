"""Which surface of each cell is the ground: the one on the shortest way from where the robot stands."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.levels.config import LevelsConfig
from torchelev.levels.surfaces import SETTLED
from torchelev.ops.windows import AROUND, neighbours

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

SLOPE = 0.5  # by which unknown ground may rise
NEAR = 1.0  # [m] within which a robot stands
NONE = -1


class Standing(NamedTuple):
    """The surface that a robot stands on: the one next to its base, from above, among those below the base."""

    cell: Int[Tensor, "B"]  #: flat number
    surface: Int[Tensor, "B"]  #: 0 the ground, k the level k - 1
    height: Float[Tensor, "B"]  #: [m]
    found: Bool[Tensor, "B"]  #: there is one in the window


def find_standing(
    heights: Float[Tensor, "B K H W"],
    known: Bool[Tensor, "B K H W"],
    support: Float[Tensor, "B K H W"],
    base: Tensor,
    square: Tensor,
) -> Standing:
    """Find the highest surface below the base in the cell nearest to it that has one.

    Within NEAR, cells whose highest surface is SETTLED come before others.

    Args:
        heights: of all surfaces [m].
        known: which of them exist.
        support: points that measured them.
        base: (B, 3) [m]; NaN: none is found.
        square: squared distance of each cell from the base (B, H, W) [m^2].
    """
    below = known & (heights <= base[:, 2, None, None, None])
    top, surface = torch.where(below, heights, -torch.inf).max(1)
    is_firm = support.gather(1, surface[:, None])[:, 0] >= SETTLED
    far = torch.where(top > -torch.inf, square, torch.inf)
    settled = torch.where(is_firm & (far <= NEAR**2), far, torch.inf).flatten(1).min(1)
    nearest = far.flatten(1).min(1)
    is_settled = settled.values < torch.inf
    cell = torch.where(is_settled, settled.indices, nearest.indices)
    found = nearest.values < torch.inf
    height, surface = (value.flatten(1).gather(1, cell[:, None])[:, 0] for value in (top, surface))
    return Standing(cell, surface, torch.where(found, height, 0.0), found)


class _Wave(NamedTuple):
    """What the last step reached: K surfaces, and the guessed ground of cells where none is known."""

    reached: Bool[Tensor, "B K+1 H W"]
    height: Float[Tensor, "B K+1 H W"]
    blind: Int[Tensor, "B K+1 H W"]  # cells since the last surface


def choose_ground(
    heights: Float[Tensor, "B K H W"],
    known: Bool[Tensor, "B K H W"],
    standing: Standing,
    grid: GridConfig,
    cfg: LevelsConfig,
    is_readable: bool,
) -> tuple[Int[Tensor, "B H W"], Bool[Tensor, "B H W"]]:
    """Find the surface that each cell is first reached on, from cell to cell by steps of at most `max_step`.

    Ground that is not known is guessed to go on as it was, over at most `max_blind`; to ground beyond it, `SLOPE` adds
    to the step. It never leads onto another surface: the floor behind a table's shadow is no way onto the table. Ways
    of few steps come before longer ones, so the way is the shortest.

    Args:
        heights: of the ground and the other surfaces [m].
        known: which of them exist.
        standing: where the search begins.
        grid: the window.
        cfg: `max_step` and `max_blind`.
        is_readable: whether the host may ask the device if the search is over.

    Returns:
        Number of the surface, 0 for the ground; NONE where only the guess arrived, or nothing did.
        Whether the ground was reached at all.
    """
    B, K, H, W = heights.shape
    at = torch.zeros(B, K + 1, H * W, dtype=torch.bool, device=heights.device)
    at[torch.arange(B), standing.surface, standing.cell] = standing.found
    at = at.unflatten(2, (H, W))
    blind_limit = cfg.blind_cells(grid)
    all_heights = torch.cat([heights, torch.zeros_like(heights[:, :1])], 1)
    wave = _Wave(at, all_heights, torch.zeros_like(all_heights, dtype=torch.int64))
    done, first = at, _first_of(at, torch.full((B, H, W), NONE, device=at.device), at.any(1))
    decided = at.any(1)
    for _ in range(H + W):
        surfaces, guess, guess_blind = _step(wave, heights, known, grid, cfg, blind_limit)
        new = torch.cat([surfaces, (guess < torch.inf)[:, None] & ~known[:, :1]], 1) & ~done
        if is_readable and not bool(new.any()):
            break
        first = _first_of(new, first, ~decided)
        decided, done = decided | new.any(1), done | new
        guessed = torch.where(guess < torch.inf, guess, 0.0)[:, None]
        blind = torch.zeros_like(wave.blind)
        blind[:, K] = guess_blind
        wave = _Wave(new, torch.cat([heights, guessed], 1), blind)
    return first, done[:, 0]


def _first_of(new: Tensor, first: Tensor, open_: Tensor) -> Int[Tensor, "B H W"]:
    """Return the surface that cells were reached on first; of several at once the ground, then the first place."""
    K = new.shape[1] - 1
    surface = torch.where(new[:, :K].any(1), new[:, :K].to(torch.int64).argmax(1), NONE)
    return torch.where(open_ & new.any(1), surface, first)


def _step(
    wave: _Wave, heights: Tensor, known: Tensor, grid: GridConfig, cfg: LevelsConfig, blind_limit: int
) -> tuple[Bool[Tensor, "B K H W"], Float[Tensor, "B H W"], Int[Tensor, "B H W"]]:
    """Return which surfaces one step reaches, and the guess where the ground is not known: its height, inf for none."""
    reached = torch.zeros_like(known)
    guess = torch.full_like(heights[:, 0], torch.inf)
    count = torch.zeros_like(guess, dtype=torch.int64)
    around = zip(*(neighbours(value, 0) for value in (wave.reached.to(heights.dtype), *wave[1:])), strict=True)
    for side in (pair for (i, j), pair in zip(AROUND, around, strict=True) if i == 0 or j == 0):
        for k, (is_reached, height, blind) in enumerate(zip(*(value.unbind(1) for value in side), strict=True)):
            comes = is_reached > 0
            limit = cfg.max_step + (SLOPE * grid.resolution) * blind.to(heights.dtype)
            near = (comes & ((heights.movedim(1, 0) - height).abs() <= limit)).movedim(0, 1)
            if k == len(heights[0]):  # what is guessed leads to the ground alone
                near = torch.cat([near[:, :1], torch.zeros_like(near[:, 1:])], 1)
            reached = reached | near
            goes_on = comes & (blind < blind_limit)
            is_lower = goes_on & (height < guess)
            is_same = goes_on & (height == guess)
            count = torch.where(is_lower, blind + 1, torch.where(is_same, torch.minimum(count, blind + 1), count))
            guess = torch.where(is_lower, height, guess)
    return reached & known, guess, count
