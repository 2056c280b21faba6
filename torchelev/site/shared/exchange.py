"""What a merge sends between ranks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.site.content.tiles import TILE
from torchelev.site.fusion.exchange import ALONE, Exchange
from torchelev.site.shared.owners import Owners, share_out
from torchelev.site.shared.ranks import Ranks

if TYPE_CHECKING:
    from jaxtyping import Int, UInt8

_CALL = "merge"


class RankExchange(Exchange):
    """What a merge sends between ranks: each call waits for all of them, and if one of them raises, all do.

    Args:
        ranks: of the site.
    """

    def __init__(self, ranks: Ranks) -> None:
        self._ranks, self.rank, self.size = ranks, ranks.rank, ranks.size
        self._owners: Owners | None = None

    def gather(self, make: Callable[[], Tensor]) -> list[Tensor]:
        """Return the rows that `make` returns on each rank."""
        return self._ranks.gather(_CALL, make)

    def sum(self, values: Tensor) -> Tensor:
        """Return the sum of the values of all ranks, added up in the order of ranks."""
        return self._ranks.all_gather(_CALL, values).sum(0, dtype=values.dtype)

    def deal(
        self, make: Callable[[], tuple[UInt8[Tensor, "n"], Sequence[int]]]
    ) -> tuple[list[UInt8[Tensor, "m"]], int]:
        """Send bytes to each rank; return those from each, and the number of all that are sent."""
        made: list[Tensor] = []

        def count() -> dict[str, list[int]]:
            memory, lengths = make()
            made.append(memory)
            return {"bytes": list(lengths)}

        sizes = [value["bytes"] for value in self._ranks.exchange(_CALL, count)]
        received = [row[self.rank] for row in sizes]
        messages = self._ranks.all_to_all(_CALL, made[0], sizes[self.rank], received)
        return list(messages.split(received)), sum(map(sum, sizes))

    def split(self, corner: Int[Tensor, "B 2"], size: Sequence[int]) -> None:
        """Share out the tiles, so that those of each rank hold the centres of equally many windows."""
        tiles = (corner + torch.tensor(size, device=corner.device) // 2) // TILE
        self._owners = share_out(self.gather(lambda: tiles))

    def find_owners(self, x: Int[Tensor, "K"], y: Int[Tensor, "K"]) -> Int[Tensor, "K"]:
        """Return the ranks that fuse the tiles with numbers x, y."""
        assert self._owners is not None
        return self._owners.find(x, y)


def exchange_of(ranks: Ranks) -> Exchange:
    """Return what a merge of these ranks sends."""
    return ALONE if ranks.size == 1 else RankExchange(ranks)
