"""Boxes on terrain tiles: what hangs over the ground or stands on it, for rays, ceilings and collisions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.sim.boxes import Boxes
from torchelev.sim.terrains.parts import Part

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, eq=False)
class Structures:
    """N boxes on each of K tiles, in the tiles' frames, with their z axes vertical.

    They belong to a `HeightField` of K tiles, which knows nothing of them: `boxes` gives those of each environment to a
    `MountedSensor`. A box of half size 0 is absent; it pads tiles with fewer boxes.

    Raises:
        ValueError: The shapes do not fit.
    """

    center: Float[Tensor, "K N 3"]  #: [m] tile frame
    half_size: Float[Tensor, "K N 3"]  #: [m] along the boxes' own axes
    yaw: Float[Tensor, "K N"]  #: [rad] of the boxes' x axes
    _pose: Tensor = field(init=False, repr=False)

    def __post_init__(self) -> None:
        shapes = [tuple(value.shape) for value in (self.center, self.half_size, self.yaw)]
        K, N = shapes[2] if self.yaw.ndim == 2 else (0, 0)
        fits = shapes == [(K, N, 3), (K, N, 3), (K, N)] and K * N > 0
        rule = "must be (K, N, 3), (K, N, 3) and (K, N)"
        require(fits, "center, half_size, yaw", rule, shapes, "pad with half sizes of 0")
        cos, sin, zero, one = self.yaw.cos(), self.yaw.sin(), torch.zeros_like(self.yaw), torch.ones_like(self.yaw)
        x, y, z = self.center.unbind(-1)
        rows = [cos, -sin, zero, x, sin, cos, zero, y, zero, zero, one, z, zero, zero, zero, one]
        object.__setattr__(self, "_pose", torch.stack(rows, -1).unflatten(-1, (4, 4)))

    @classmethod
    def of_tiles(cls, tiles: Sequence[Sequence[Part]], device: torch.device | str = "cpu") -> Structures:
        """Build them from the parts on each tile: see `torchelev.sim.terrains.parts`.

        Raises:
            ValueError: There is no tile, or a number is not finite.
        """
        require(len(tiles) > 0, "tiles", "must not be empty", tiles, "give a list of parts for each tile")
        count = max(1, *(len(parts) for parts in tiles))
        rows = [[(*center, *half, yaw) for center, half, yaw in parts] for parts in tiles]
        table = torch.tensor([own + [(0.0,) * 7] * (count - len(own)) for own in rows]).view(len(tiles), count, 7)
        require(bool(table.isfinite().all()), "tiles", "must be finite", "NaN or inf", "check center and half_size")
        return cls(*(value.to(device) for value in (table[..., :3], table[..., 3:6], table[..., 6])))

    def to(self, device: torch.device | str) -> Structures:
        """Return the same boxes on a device."""
        return Structures(*(value.to(device) for value in (self.center, self.half_size, self.yaw)))

    def boxes(self, tile_ids: Int[Tensor, "B"]) -> Boxes:
        """Return the boxes on each environment's tile, as rays take them."""
        return Boxes(self._pose[tile_ids], self.half_size[tile_ids])

    def underside(
        self, tile_ids: Int[Tensor, "B"], xy: Float[Tensor, "B M 2"], above: Float[Tensor, "B M"]
    ) -> Float[Tensor, "B M"]:
        """Return the lowest underside [m] above a height at each place, inf where there is none: the ceiling.

        Args:
            tile_ids: The tile of each environment.
            xy: Places [m] in the frame of the tile.
            above: Undersides at this height or lower do not count [m].
        """
        low, _ = self._limits(tile_ids)
        counts = self._covers(tile_ids, xy) & (low[:, None] > above[..., None])
        return _masked(low, counts, math.inf).amin(-1)

    def top(
        self, tile_ids: Int[Tensor, "B"], xy: Float[Tensor, "B M 2"], below: Float[Tensor, "B M"]
    ) -> Float[Tensor, "B M"]:
        """Return the highest top [m] not above a height at each place, -inf where there is none: what can be stood on.

        Args:
            tile_ids: The tile of each environment.
            xy: Places [m] in the frame of the tile.
            below: Higher tops do not count [m].
        """
        _, high = self._limits(tile_ids)
        counts = self._covers(tile_ids, xy) & (high[:, None] <= below[..., None])
        return _masked(high, counts, -math.inf).amax(-1)

    def meets(
        self,
        tile_ids: Int[Tensor, "B"],
        xy: Float[Tensor, "B 2"],
        yaw: Float[Tensor, "B"],
        size: tuple[float, float],
        bottom: Float[Tensor, "B"],
        top: Float[Tensor, "B"],
    ) -> Bool[Tensor, "B"]:
        """Return whether an upright body meets a box.

        Two rectangles are apart if they are so along an axis of one of them (separating axes), or if their heights are.

        Args:
            tile_ids: The tile of each environment.
            xy: Centres of the bodies [m] in the frame of the tile.
            yaw: Headings of the bodies [rad].
            size: Length and width of the bodies [m].
            bottom: Their lowest height [m].
            top: Their highest height [m].
        """
        half = self.half_size[tile_ids]
        (x, y), (a, b), (c, d) = self._local(tile_ids, xy[:, None]), half.unbind(-1)[:2], (size[0] / 2, size[1] / 2)
        turn = yaw[:, None] - self.yaw[tile_ids]
        cos, sin = turn.cos(), turn.sin()
        along, across = cos * x[:, 0] + sin * y[:, 0], cos * y[:, 0] - sin * x[:, 0]
        cos, sin = cos.abs(), sin.abs()
        meets = (x[:, 0].abs() < a + cos * c + sin * d) & (y[:, 0].abs() < b + sin * c + cos * d)
        meets = meets & (along.abs() < c + cos * a + sin * b) & (across.abs() < d + sin * a + cos * b)
        low, high = self._limits(tile_ids)
        meets = meets & (low < top[:, None]) & (high > bottom[:, None]) & (half > 0).all(-1)
        return meets.any(-1)

    def _limits(self, tile_ids: Tensor) -> tuple[Float[Tensor, "B N"], Float[Tensor, "B N"]]:
        """Return the heights [m] of undersides and tops."""
        z, half = self.center[tile_ids, :, 2], self.half_size[tile_ids, :, 2]
        return z - half, z + half

    def _covers(self, tile_ids: Tensor, xy: Tensor) -> Bool[Tensor, "B M N"]:
        """Return which boxes lie over or under each place."""
        half = self.half_size[tile_ids, None]
        x, y = self._local(tile_ids, xy)
        return (x.abs() <= half[..., 0]) & (y.abs() <= half[..., 1]) & (half > 0).all(-1)

    def _local(self, tile_ids: Tensor, xy: Float[Tensor, "B M 2"]) -> tuple[Tensor, Tensor]:
        """Return places in the frames of the boxes (B, M, N) [m]."""
        offset = xy[:, :, None] - self.center[tile_ids, None, :, :2]
        yaw = self.yaw[tile_ids, None]
        cos, sin = yaw.cos(), yaw.sin()
        return cos * offset[..., 0] + sin * offset[..., 1], cos * offset[..., 1] - sin * offset[..., 0]


def _masked(values: Float[Tensor, "B N"], counts: Bool[Tensor, "B M N"], other: float) -> Float[Tensor, "B M N"]:
    return values[:, None].expand(counts.shape).masked_fill(~counts, other)
