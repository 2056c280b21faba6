"""The window follows the robot, by whole cells."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.operators import moved
from torchelev.ops.storage import as_bits, from_bits, read, realize_all
from torchelev.state import BLANK, LAYERS, MASKS, MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Float, Int


def window_corner(base: Float[Tensor, "B 2"], anchor: Int[Tensor, "B 2"], grid: GridConfig) -> Int[Tensor, "B 2"]:
    """Return the corner of the window that is centred on `base` to within half a cell."""
    half = torch.stack([base.new_full((), size / 2) for size in (grid.height, grid.width)])
    return anchor + torch.floor(base / grid.resolution - half + 0.5).to(torch.int64)


def gathered(layers: list[Tensor], shift: Int[Tensor, "B 2"], blanks: list[float], grid: GridConfig) -> list[Tensor]:
    """Shift layers by gathering; cells that enter the window get the layer's blank value."""
    i = torch.arange(grid.height, device=shift.device)[None, :, None] + shift[:, 0, None, None]
    j = torch.arange(grid.width, device=shift.device)[None, None, :] + shift[:, 1, None, None]
    entering = (i < 0) | (i >= grid.height) | (j < 0) | (j >= grid.width)
    index = i.clamp(0, grid.height - 1) * grid.width + j.clamp(0, grid.width - 1)
    values = [read(layer.flatten(1), index) for layer in realize_all(*layers)]
    # Bytes become numbers here: among these, compiled code chooses so much faster that all of it takes half as long.
    blanked = [torch.where(entering, blank, value) for value, blank in zip(values, blanks, strict=True)]
    blanked = [value.to(layer.dtype) for value, layer in zip(blanked, layers, strict=True)]
    return realize_all(*blanked)


def recenter(state: MapState, m: Measurement, grid: GridConfig) -> MapState:
    """Move the window by whole cells so that it follows the robot (paper, Sec. II: a robot-centric map).

    World-fixed cells keep their value to the bit, entering cells are blank. Environments move independently.
    Without a base pose the window stays.
    """
    if m.base is None:
        return state
    moves = torch.isfinite(m.base).all(1)
    corner = torch.where(moves[:, None], window_corner(m.base[:, :2], m.anchor, grid), state.corner)
    # A shift of a whole window blanks everything; the clamp keeps the index arithmetic small.
    shift = (corner - state.corner).clamp(-max(grid.height, grid.width), max(grid.height, grid.width))
    corner, shift = realize_all(corner, shift)
    names = [name for name in LAYERS if name not in MASKS]
    # All masks move as the bits of one layer.
    layers = [*(getattr(state, name) for name in names), as_bits([getattr(state, name) for name in MASKS])]
    blanks = [*(BLANK.get(name, 0.0) for name in names), 0.0]
    # Copying takes an eighth of the time of gathering that is not compiled, but has no gradient, and the host must know
    # the shifts.
    eager = not torch.compiler.is_compiling() and not torch.is_grad_enabled()
    few = eager and shift.shape[0] <= 4 and shift.device.type == "cpu"
    *values, bits = moved(layers, shift, blanks) if few else gathered(layers, shift, blanks, grid)
    fields: dict[str, Any] = dict(zip((*names, *MASKS), (*values, *from_bits(bits, len(MASKS))), strict=True))
    base_height = torch.where(moves, m.base[:, 2], state.base_height)
    return state._replace(corner=corner, base_height=base_height, **fields)
