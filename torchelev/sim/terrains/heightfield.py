"""Terrain as heights on a grid, many tiles at once, and the bounds that let rays skip the air over it."""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.errors import require

if TYPE_CHECKING:
    from jaxtyping import Float, Int

BLOCKS = (1, 2, 4, 8, 16, 32)  # [cells] edges of the blocks whose highest points are kept
MOST_SAMPLES = 2**24 - 2**14  # float32 counts the samples of a tile and its rim exactly


class Bounds(NamedTuple):
    """The highest point near each block of cells, for L sizes of blocks and last for the tile as a whole.

    `highest` holds the tiles of one size, row by row, then those of the next.
    """

    highest: Float[Tensor, "T"]  #: [m] within the block and the eight around it
    edge: Float[Tensor, "L 1"]  #: [cells] of a block
    reach: Float[Tensor, "L 1"]  #: [cells] from one block ahead to its far side
    last: Float[Tensor, "2 L 1"]  #: number of the last block along x and y
    row: Float[Tensor, "L 1"]  #: blocks along y
    first: Int[Tensor, "L 1"]  #: where tile 0 begins in `highest`
    size: Int[Tensor, "L 1"]  #: blocks in a tile


class HeightField:
    """K tiles of terrain, each in its own frame, whose origin lies in the middle of the tile.

    Sample [k, i, j] is the height at x = (i - (H - 1) / 2) * resolution, and y likewise with j. Between samples the
    surface is bilinear; beyond the rim the rim's height goes on. Cells lie between samples, numbered from 0, which is
    the one before the first sample, to H (W), the one behind the last; those two go on for ever. With its bounds a tile
    takes 2.4 times the memory of its samples.

    Args:
        heights: (K, H, W) [m], at least 2 x 2 samples a tile. They are copied.
        resolution: distance of the samples [m].

    Raises ValueError or TypeError for another shape, heights that are not finite, and a resolution that is not
    positive.
    """

    def __init__(self, heights: Float[Tensor, "K H W"], resolution: float) -> None:
        actual = type(heights).__name__
        require(isinstance(heights, Tensor), "heights", "must be a tensor", actual, "use torch.as_tensor", TypeError)
        fits = heights.ndim == 3 and heights.shape[0] >= 1 and min(heights.shape[1:]) >= 2
        require(fits, "heights", "must be (K, H, W) with H, W >= 2", tuple(heights.shape), "give K tiles of samples")
        few = heights.shape[1] * heights.shape[2] <= MOST_SAMPLES
        require(few, "heights", f"must have at most {MOST_SAMPLES} samples a tile", tuple(heights.shape), "cut it up")
        require(bool(heights.isfinite().all()), "heights", "must be finite", "NaN or inf", "fill the holes")
        require(0 < resolution < math.inf, "resolution", "must be positive", resolution, "give metres per sample")
        self.resolution = float(resolution)
        self.padded = F.pad(heights.float()[:, None], (1, 1, 1, 1), mode="replicate")[:, 0].contiguous()
        size = self.padded.new_tensor(self.padded.shape[1:])
        self.middle = (size - 1) / 2  # (2,) [cells] the frame's origin, from the padded rim
        self.last = size - 2  # (2,) number of the last cell
        self.bounds = highest_near(self.heights)

    @property
    def heights(self) -> Float[Tensor, "K H W"]:
        """The samples [m]."""
        return self.padded[:, 1:-1, 1:-1]

    @property
    def device(self) -> torch.device:
        """Where the tiles are."""
        return self.padded.device

    @property
    def num_tiles(self) -> int:
        """K."""
        return self.padded.shape[0]

    def to(self, device: torch.device | str) -> HeightField:
        """Return the same tiles on a device."""
        moved = copy.copy(self)
        for name in ("padded", "middle", "last"):
            setattr(moved, name, getattr(self, name).to(device))
        moved.bounds = Bounds(*(value.to(device) for value in self.bounds))
        return moved

    def height(self, tile_ids: Int[Tensor, "B"], xy: Float[Tensor, "B M 2"]) -> Float[Tensor, "B M"]:
        """Return the surface's height [m] at places xy [m] of each environment's tile; at NaN, of the tile's middle.

        Raises ValueError for shapes that do not fit.
        """
        fits = tile_ids.ndim == 1 and xy.ndim == 3 and xy.shape[::2] == (len(tile_ids), 2)
        actual = f"{tuple(tile_ids.shape)} and {tuple(xy.shape)}"
        require(fits, "tile_ids, xy", "must be (B,) and (B, M, 2)", actual, "give one tile and M places each")
        offset = (xy / self.resolution).to(self.padded.dtype).nan_to_num(0.0)  # NaN would become an index
        place = offset.movedim(-1, 0) + self.middle[:, None, None]
        cell = place.floor()
        a, b, c, d = self.surface(cell, tile_ids[:, None])
        u, v = place - cell
        return a + b * u + (c + d * u) * v

    def surface(self, cell: Float[Tensor, "2 *N"], tile: Int[Tensor, "*N"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return a, b, c, d (*N) of the surface z = a + b u + c v + d u v [m], u and v counted in the cell from 0 to 1.

        Cells may lie beyond the rim.
        """
        cell = torch.minimum(cell.clamp(min=0), self.last.view(2, *[1] * (cell.ndim - 1)))
        W = self.padded.shape[2]
        here = torch.add(cell[1], cell[0], alpha=W).to(torch.int64) + tile * (self.padded.shape[1] * W)
        a = self._at(here)
        b, c = self._at(here + W) - a, self._at(here + 1) - a
        return a, b, c, self._at(here + (W + 1)) - a - b - c

    def _at(self, sample: Tensor) -> Tensor:
        return self.padded.view(-1).index_select(0, sample.flatten()).view(sample.shape)


def highest_near(heights: Float[Tensor, "K H W"]) -> Bounds:
    """Compute the bounds of tiles."""
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
