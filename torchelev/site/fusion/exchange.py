"""What a merge sends to the processes that share its work: nothing if there is only one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Int, UInt8


class Exchange:
    """One process. `torchelev.site.shared.exchange` has the same for ranks.

    Attributes:
        rank: of this process.
        size: R, number of processes.
    """

    rank, size = 0, 1

    def gather(self, make: Callable[[], Tensor]) -> list[Tensor]:
        """Return the rows (n, ...) that `make` returns on each rank; n may differ. If it raises on one, all raise."""
        return [make()]

    def sum(self, values: Tensor) -> Tensor:
        """Return the sum of the values of all ranks, of one shape: the same bits on all of them."""
        return values

    def deal(
        self, make: Callable[[], tuple[UInt8[Tensor, "n"], Sequence[int]]]
    ) -> tuple[list[UInt8[Tensor, "m"]], int]:
        """Send bytes to each rank; return those from each, and the number of all that are sent.

        Args:
            make: returns the bytes for all ranks, and how many are for each. If it raises on one rank, all raise.
        """
        memory, lengths = make()
        return [memory], sum(lengths)

    def split(self, corner: Int[Tensor, "B 2"], size: Sequence[int]) -> None:
        """Share out the tiles for a merge of windows of this size [cells], whose first cells these are."""

    def find_owners(self, x: Int[Tensor, "K"], y: Int[Tensor, "K"]) -> Int[Tensor, "K"]:
        """Return the ranks that fuse the tiles with numbers x, y."""
        return torch.zeros_like(x)


ALONE = Exchange()
