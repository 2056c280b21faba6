"""The lattice of cells and the window on it: which cell a point lies in, and where cells lie.

Cell k of an axis spans k * resolution to (k + 1) * resolution in the map frame, wherever the window is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.errors import require, require_positive, whole_cells

if TYPE_CHECKING:
    from jaxtyping import Float, Int


MIN_RESOLUTION = 1e-4  # [m] finer cells are no cells of ground, and their numbers would not fit


@dataclass(frozen=True, kw_only=True)
class GridConfig:
    """Size of the window and of its cells."""

    resolution: float = 0.04  #: [m] side length of a cell; larger cells are faster, smaller cells show smaller steps
    length_x: float = 10.0  #: [m] window length along x, a whole number of cells; a larger window is slower
    length_y: float = 10.0  #: [m] window length along y, a whole number of cells

    def __post_init__(self) -> None:
        require_positive(**{"grid.resolution": self.resolution})
        fits, rule = self.resolution >= MIN_RESOLUTION, f"must be at least {MIN_RESOLUTION} m"
        require(fits, "grid.resolution", rule, self.resolution, "give metres")
        for name in ("length_x", "length_y"):
            whole_cells(f"grid.{name}", getattr(self, name), self.resolution)

    @property
    def height(self) -> int:
        """H, number of cells along x."""
        return round(self.length_x / self.resolution)

    @property
    def width(self) -> int:
        """W, number of cells along y."""
        return round(self.length_y / self.resolution)

    @property
    def num_cells(self) -> int:
        """H * W, number of cells."""
        return self.height * self.width


def grid_of(size: Sequence[int], resolution: float) -> GridConfig:
    """Return the grid of so many cells along x and y."""
    height, width = size
    return GridConfig(resolution=resolution, length_x=height * resolution, length_y=width * resolution)


def locate(x: Tensor, y: Tensor, offset: Float[Tensor, "B 2"], grid: GridConfig) -> tuple[Tensor, Tensor]:
    """Find the cells that points lie in.

    Args:
        x: (B, ...) [m] from a corner of the lattice.
        y: (B, ...) [m] from that corner.
        offset: position of that corner in the window [m].
        grid: the window.

    Returns:
        Flat cell numbers (B, ...) int32, of the nearest cell for points outside the window, and a mask of the points
        inside.
    """
    first = torch.round(offset / grid.resolution).view(-1, 2, *[1] * (x.ndim - 1))
    # Divide before adding whole cells: the result is then the same wherever the window is.
    i = torch.floor(x / grid.resolution) + first[:, 0]
    j = torch.floor(y / grid.resolution) + first[:, 1]
    near_i, near_j = i.clamp(0, grid.height - 1), j.clamp(0, grid.width - 1)
    # In integers: float32 is exact up to 2^24 only.
    slot = near_i.to(torch.int32) * grid.width + near_j.to(torch.int32)
    return slot, (i == near_i) & (j == near_j)


def window_center(corner: Int[Tensor, "B 2"], grid: GridConfig) -> Float[Tensor, "B 2"]:
    """Return the centres of the windows [m], map frame, float64."""
    size = torch.stack([corner.new_full((), cells) for cells in (grid.height, grid.width)])
    return (corner.double() + size.double() / 2) * grid.resolution


def cell_centers(corner: Int[Tensor, "B 2"], grid: GridConfig) -> Float[Tensor, "B H W 2"]:
    """Return the centres of the cells [m], map frame, float64: (k + 0.5) * resolution for cell k."""
    x = torch.arange(grid.height, device=corner.device) + corner[:, 0, None]
    y = torch.arange(grid.width, device=corner.device) + corner[:, 1, None]
    x, y = ((k.double() + 0.5) * grid.resolution for k in (x, y))
    shape = (corner.shape[0], grid.height, grid.width)
    return torch.stack([x[:, :, None].expand(shape), y[:, None, :].expand(shape)], -1)
