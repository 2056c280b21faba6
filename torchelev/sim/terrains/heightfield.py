"""Terrain as heights on a grid, many tiles at once, with the bounds by which rays skip the free space above it."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.errors import require
from torchelev.sim.terrains import heights_kernel
from torchelev.sim.terrains.surfaces import Coefficients, Surface, require_surface

if TYPE_CHECKING:
    from jaxtyping import Float, Int

BLOCKS = (1, 2, 4, 8, 16, 32)  # [cells] side lengths of the blocks with bounds
_MAX_SAMPLES = 2**24 - 2**14  # of a tile; with its rim float32 still counts them exactly


class Bounds(NamedTuple):
    """The highest point near each block of cells, at L levels: one for each block size, and one for the whole tile.

    `highest` holds all tiles of the first level, row by row, then those of the next levels.
    """

    highest: Float[Tensor, "T"]  #: [m] highest point in the block and in its eight neighbours
    edge: Float[Tensor, "L 1"]  #: [cells] side length of a block
    reach: Float[Tensor, "L 1"]  #: [cells] how far ahead of a ray the bound one block ahead holds
    last: Float[Tensor, "2 L 1"]  #: index of the last block along x and y
    row: Float[Tensor, "L 1"]  #: number of blocks along y
    first: Int[Tensor, "L 1"]  #: index of tile 0 in `highest`
    size: Int[Tensor, "L 1"]  #: number of blocks in a tile


class HeightField:
    """K terrain tiles, each in its own frame, whose origin is the centre of the tile.

    Sample [k, i, j] is the height at x = (i - (H - 1) / 2) * resolution, and y likewise with j. Between samples the
    surface is bilinear, or it is two triangles in each cell, as physics engines take it: `torchelev.sim.surface_of`
    names those of an engine. Heights and rays then meet what feet stand on. Beyond the rim of a tile the height of the
    rim continues. Cells lie between the samples. Their indices run from 0, before the first sample, to H (W), behind
    the last one; these two extend to infinity. With its bounds a tile takes 2.4 times the memory of its samples.

    Args:
        heights: (K, H, W) [m], at least 2 x 2 samples for each tile. They are copied.
        resolution: Distance between samples [m].
        surface: "bilinear" or "triangles".
        diagonal: The edge that the two triangles of a cell share: "rising" runs from sample (i, j) to (i + 1, j + 1),
            "falling" from (i + 1, j) to (i, j + 1). A bilinear surface has none.

    Raises:
        TypeError: `heights` is not a tensor.
        ValueError: The shape does not fit, a height is not finite, the resolution is not positive, or there is no such
            surface or diagonal.
    """

    def __init__(
        self,
        heights: Float[Tensor, "K H W"],
        resolution: float,
        surface: str = "bilinear",
        diagonal: str = "rising",
    ) -> None:
        actual = type(heights).__name__
        require(isinstance(heights, Tensor), "heights", "must be a tensor", actual, "use torch.as_tensor", TypeError)
        fits = heights.ndim == 3 and heights.shape[0] >= 1 and min(heights.shape[1:]) >= 2
        require(fits, "heights", "must be (K, H, W) with H, W >= 2", tuple(heights.shape), "give K tiles of samples")
        fits = heights.shape[1] * heights.shape[2] <= _MAX_SAMPLES
        require(fits, "heights", f"must have at most {_MAX_SAMPLES} samples a tile", tuple(heights.shape), "split it")
        require(bool(heights.isfinite().all()), "heights", "must be finite", "NaN or inf", "fill the holes")
        require(0 < resolution < math.inf, "resolution", "must be positive", resolution, "give metres per sample")
        self.surface: Surface = require_surface(surface, diagonal)
        self.resolution = float(resolution)
        self.padded = F.pad(heights.float()[:, None], (1, 1, 1, 1), mode="replicate")[:, 0].contiguous()
        size = self.padded.new_tensor(self.padded.shape[1:])
        self.middle = (size - 1) / 2  # (2,) [cells] origin of the tile frame, counted from the padded rim
        self.last = size - 2  # (2,) index of the last cell
        self.bounds = _compute_bounds(self.heights)

    @property
    def heights(self) -> Float[Tensor, "K H W"]:
        """The samples [m]."""
        return self.padded[:, 1:-1, 1:-1]

    @property
    def device(self) -> torch.device:
        """Where the tiles are stored."""
        return self.padded.device

    @property
    def num_tiles(self) -> int:
        """Number of tiles K."""
        return self.padded.shape[0]

    def to(self, device: torch.device | str) -> HeightField:
        """Return the same tiles on a device."""
        moved = copy.copy(self)
        for name in ("padded", "middle", "last"):
            setattr(moved, name, getattr(self, name).to(device))
        moved.bounds = Bounds(*(value.to(device) for value in self.bounds))
        return moved

    def with_surface(self, surface: str, diagonal: str = "rising") -> HeightField:
        """Return the same tiles, which share their memory, with another surface between the samples.

        Raises:
            ValueError: There is no such surface or diagonal.
        """
        changed = copy.copy(self)
        changed.surface = require_surface(surface, diagonal)
        return changed

    def height(self, tile_ids: Int[Tensor, "B"], xy: Float[Tensor, "B M 2"]) -> Float[Tensor, "B M"]:
        """Return the height of the surface [m] at xy [m] on each environment's tile; NaN counts as 0.

        Raises:
            ValueError: The shapes do not fit.
        """
        return heights_of((self,), tile_ids, xy)[0]

    def coefficients(self, cell: Float[Tensor, "2 *N"], tile: Int[Tensor, "*N"]) -> Coefficients:
        """Return a, b, c, d (*N) of the surface in cells, which may lie beyond the rim; see `surfaces`."""
        cell = torch.minimum(cell.clamp(min=0), self.last.view(2, *[1] * (cell.ndim - 1)))
        W = self.padded.shape[2]
        index = torch.add(cell[1], cell[0], alpha=W).to(torch.int64) + tile * (self.padded.shape[1] * W)
        a = self._at(index)
        b, c = self._at(index + W) - a, self._at(index + 1) - a
        return a, b, c, self._at(index + (W + 1)) - a - b - c

    def _at(self, index: Tensor) -> Tensor:
        return self.padded.view(-1).index_select(0, index.flatten()).view(index.shape)


def heights_of(
    fields: Sequence[HeightField], tile_ids: Int[Tensor, "B"], xy: Float[Tensor, "B M 2"]
) -> Sequence[Float[Tensor, "B M"]]:
    """Return the heights of several fields of the same size, resolution and surface [m] at the same places.

    See `HeightField.height`.

    Raises:
        ValueError: The shapes do not fit.
    """
    _check_places(fields, tile_ids, xy)
    heights = heights_kernel.read_heights(fields, tile_ids, xy)
    return [_read_heights(field, tile_ids, xy) for field in fields] if heights is None else heights.unbind(0)


def _read_heights(field: HeightField, tile_ids: Tensor, xy: Tensor) -> Float[Tensor, "B M"]:
    offset = (xy / field.resolution).to(field.padded.dtype).nan_to_num(0.0)  # NaN would become an index
    position = offset.movedim(-1, 0) + field.middle[:, None, None]
    cell = position.floor()
    u, v = position - cell
    return field.surface.height(field.coefficients(cell, tile_ids[:, None]), u, v)


def _check_places(fields: Sequence[HeightField], tile_ids: Tensor, xy: Tensor) -> None:
    fits = tile_ids.ndim == 1 and xy.ndim == 3 and xy.shape[::2] == (len(tile_ids), 2)
    actual, hint = f"{tuple(tile_ids.shape)} and {tuple(xy.shape)}", "give one tile and M points for each environment"
    require(fits, "tile_ids, xy", "must be (B,) and (B, M, 2)", actual, hint)
    kinds = [(tuple(field.padded.shape), field.resolution, field.surface) for field in fields]
    require(len(set(kinds)) == 1, "fields", "must be alike in size, resolution and surface", kinds, "read each alone")


def _compute_bounds(heights: Float[Tensor, "K H W"]) -> Bounds:
    """Return the bounds of tiles."""
    K = len(heights)
    samples = F.pad(heights[:, None], (1, 1, 1, 1), mode="replicate")
    cells = F.max_pool2d(samples, 2, 1)
    levels = [F.max_pool2d(F.max_pool2d(cells, edge, ceil_mode=True), 3, 1, padding=1) for edge in BLOCKS]
    levels.append(heights.amax((1, 2)).view(K, 1, 1, 1))
    sizes = torch.tensor([level.shape[2:] for level in levels], device=heights.device)
    count = sizes.prod(1)
    edge = heights.new_tensor([*BLOCKS, 1.0])
    reach = torch.cat([2 * edge[:-1], edge[:1] * 1e9])
    return Bounds(
        highest=torch.cat([level.flatten() for level in levels]),
        edge=edge[:, None],
        reach=reach[:, None],
        last=(sizes.t()[..., None] - 1).to(heights.dtype),
        row=sizes[:, 1:].to(heights.dtype),
        first=(K * (count.cumsum(0) - count))[:, None],
        size=count[:, None],
    )
