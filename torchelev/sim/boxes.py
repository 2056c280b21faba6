"""Boxes in each environment, which rays hit: people, other robots, and what hangs over the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float


class Boxes(NamedTuple):
    """K boxes in each environment; a box with a half size of zero or less, or without a finite pose, is absent."""

    T_map_box: Float[Tensor, "B K 4 4"]  #: poses of the boxes' centres
    half_size: Float[Tensor, "B K 3"]  #: [m] half the side lengths; 0 to pad environments with fewer boxes

    def moved(self, T: Float[Tensor, "B 4 4"]) -> Boxes:
        """Return boxes of frame b in frame a, with `T` = T_a_b."""
        return Boxes(T[:, None].to(self.T_map_box.dtype) @ self.T_map_box, self.half_size)

    def joined(self, other: Boxes) -> Boxes:
        """Return these boxes followed by `other`."""
        T = torch.cat([self.T_map_box, other.T_map_box.to(self.T_map_box.dtype)], 1)
        return Boxes(T, torch.cat([self.half_size, other.half_size.to(self.half_size.dtype)], 1))
