"""The window follows the robot, by whole cells."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.moving import move_layers
from torchelev.state import BLANK, LAYERS, MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


def recenter(state: MapState, m: Measurement, grid: GridConfig) -> MapState:
    """Move the window by whole cells so that it follows the robot (paper, Sec. II: a robot-centric map).

    World-fixed cells keep their value to the bit, entering cells are blank. Environments move independently.
    Without a base pose the window stays.
    """
    return state if m.base is None else follow(state, m.base, m.anchor, grid)


def follow(
    state: MapState,
    base: Float[Tensor, "B 3"],
    anchor: Int[Tensor, "B 2"],
    grid: GridConfig,
) -> MapState:
    """Move the windows by whole cells to `base` [m], whose x, y count from cell `anchor`; not where it is NaN."""
    moves = torch.isfinite(base).all(1)
    corner, shift = move_corner(state, base, anchor, moves, grid)
    layers: Any = move_layers({name: getattr(state, name) for name in LAYERS}, shift, BLANK)
    base_height = torch.where(moves, base[:, 2], state.base_height)
    return state._replace(corner=corner, base_height=base_height, **layers)


def move_corner(
    state: MapState, base: Float[Tensor, "B 3"], anchor: Int[Tensor, "B 2"], moves: Bool[Tensor, "B"], grid: GridConfig
) -> tuple[Int[Tensor, "B 2"], Int[Tensor, "B 2"]]:
    """Return the windows' new corners, and by how many cells they move."""
    corner = torch.where(moves[:, None], window_corner(base[:, :2], anchor, grid), state.corner)
    # A shift by a whole window blanks everything; the clamp keeps the index arithmetic small.
    largest = max(grid.height, grid.width)
    return corner, (corner - state.corner).clamp(-largest, largest)


def window_corner(base: Float[Tensor, "B 2"], anchor: Int[Tensor, "B 2"], grid: GridConfig) -> Int[Tensor, "B 2"]:
    """Return the corner of the window that is centred on `base` to within half a cell."""
    half = torch.stack([base.new_full((), size / 2) for size in (grid.height, grid.width)])
    return anchor + torch.floor(base / grid.resolution - half + 0.5).to(torch.int64)
