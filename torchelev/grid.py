"""Where cells are: the lattice, the window on it, and moving that window with the robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import require_positive, whole_cells
from torchelev.ops.operators import cell_sums, moved
from torchelev.ops.storage import as_bits, from_bits, read, realize, realize_all
from torchelev.state import BLANK, LAYERS, MASKS, MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, kw_only=True)
class GridConfig:
    """Size of the window and of its cells."""

    resolution: float = 0.04  # [m]
    length_x: float = 10.0  # [m]
    length_y: float = 10.0  # [m]

    def __post_init__(self) -> None:
        require_positive(**{"grid.resolution": self.resolution})
        for name in ("length_x", "length_y"):
            whole_cells(f"grid.{name}", getattr(self, name), self.resolution)

    @property
    def height(self) -> int:
        """Cells along x (H)."""
        return round(self.length_x / self.resolution)

    @property
    def width(self) -> int:
        """Cells along y (W)."""
        return round(self.length_y / self.resolution)

    @property
    def num_cells(self) -> int:
        """H * W."""
        return self.height * self.width


class PointCells(NamedTuple):
    """Which cell each point falls into. Points outside point to some cell, so mask what is summed by `inside`."""

    slot: Int[Tensor, "B M"]
    inside: Bool[Tensor, "B M"]
    num_cells: int

    def sums(self, *columns: Float[Tensor, "B M"]) -> tuple[Float[Tensor, "B C"], ...]:
        """Sum columns of the points' values per cell; they must be zero outside."""
        return cell_sums(self.slot, torch.stack(columns), self.num_cells).unbind(0)

    def take(self, *layers: Tensor) -> list[Tensor]:
        """Give each point its cell's value of each layer: (B, H, W) or (B, C) -> (B, M)."""
        return [cells.flatten(1).gather(1, self.slot) for cells in realize_all(*layers)]


def lattice_offset(state: MapState, m: Measurement, grid: GridConfig) -> Float[Tensor, "B 2"]:
    """Return where the measurement's horizontal origin lies, seen from the window's corner [m]."""
    # A cell number fits float32 exactly only as a difference of near ones; far ones are clamped, they are outside.
    cells = (m.anchor - state.corner).clamp(-(2**22), 2**22)
    return realize(cells.to(m.points.dtype) * grid.resolution)


def center_offsets(state: MapState, m: Measurement, grid: GridConfig) -> tuple[Tensor, Tensor]:
    """Return x (B, H, 1) and y (B, 1, W) of the cell centres [m], counted from the measurement's horizontal origin."""
    cells = (state.corner - m.anchor).clamp(-(2**22), 2**22).to(m.points.dtype) + 0.5
    x = torch.arange(grid.height, device=cells.device) + cells[:, 0, None]
    y = torch.arange(grid.width, device=cells.device) + cells[:, 1, None]
    x, y = realize_all(x * grid.resolution, y * grid.resolution)
    return x[:, :, None], y[:, None, :]


def locate(x: Tensor, y: Tensor, offset: Float[Tensor, "B 2"], grid: GridConfig) -> tuple[Tensor, Tensor]:
    """Return the flat cell number, int32, of each place (x, y), both (B, ...), and whether it lies in the window.

    x and y count from a lattice corner that lies at `offset` in the window. Outside, the number is the nearest cell's.
    """
    first = torch.round(offset / grid.resolution).view(-1, 2, *[1] * (x.ndim - 1))
    # Divide before adding whole cells: the result is then the same wherever the window is.
    i = torch.floor(x / grid.resolution) + first[:, 0]
    j = torch.floor(y / grid.resolution) + first[:, 1]
    near_i, near_j = i.clamp(0, grid.height - 1), j.clamp(0, grid.width - 1)
    # In integers: float32 counts no farther than 2^24 cells.
    slot = near_i.to(torch.int32) * grid.width + near_j.to(torch.int32)
    return slot, (i == near_i) & (j == near_j)


def cells_of(state: MapState, m: Measurement, grid: GridConfig) -> PointCells:
    """Find the cell of each point that measures the ground."""
    slot, inside = locate(m.points[..., 0], m.points[..., 1], lattice_offset(state, m, grid), grid)
    slot, inside = realize_all(slot.to(torch.int64), inside & m.used)
    return PointCells(slot, inside, grid.num_cells)


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


def window_center(corner: Int[Tensor, "B 2"], grid: GridConfig) -> Float[Tensor, "B 2"]:
    """Return the windows' centres [m], map frame, float64."""
    size = torch.stack([corner.new_full((), cells) for cells in (grid.height, grid.width)])
    return (corner.double() + size.double() / 2) * grid.resolution


def cell_centers(corner: Int[Tensor, "B 2"], grid: GridConfig) -> Float[Tensor, "B H W 2"]:
    """Return the cell centres [m], map frame, float64: (k + 0.5) * resolution for cell number k."""
    x = torch.arange(grid.height, device=corner.device) + corner[:, 0, None]
    y = torch.arange(grid.width, device=corner.device) + corner[:, 1, None]
    x, y = ((k.double() + 0.5) * grid.resolution for k in (x, y))
    shape = (corner.shape[0], grid.height, grid.width)
    return torch.stack([x[:, :, None].expand(shape), y[:, None, :].expand(shape)], -1)
