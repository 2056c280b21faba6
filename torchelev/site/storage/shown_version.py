"""What the stores of both engines share: the header of their version, and committing tiles in one call."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike, NDArray

from torchelev.site.storage.interface import Arrays, Note, Tile
from torchelev.site.storage.site_header import Header

if TYPE_CHECKING:
    from typing_extensions import Self


class ShownVersion:
    """The part of a `SiteStore` that follows from its header and its list of tiles; as a context, it closes itself."""

    _header: Header
    _tiles: frozenset[Tile]

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the L layers."""
        return self._header.layers

    @property
    def tile_size(self) -> int:
        """T, cells on the side of a tile."""
        return self._header.tile_size

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes of the version that it shows: the last commit, or of other processes', what `refresh` found."""
        return dict(self._header.attributes)

    @property
    def tiles(self) -> frozenset[Tile]:
        """Tiles that are stored; of other processes' tiles, those that `refresh` found."""
        return self._tiles

    def commit(
        self,
        tiles: Sequence[Tile] | NDArray,
        values: ArrayLike,
        attributes: Mapping[str, Any],
        arrays: Arrays | None = None,
    ) -> None:
        """Store tiles, attributes and arrays together, or none of them if this raises or the process is killed.

        Args:
            tiles: n different pairs; other tiles stay as they are.
            values: (n, L, T, T), NaN where unknown.
            attributes: JSON values, which replace all earlier ones.
            arrays: further arrays and their attributes by name, such as "keyframes/0001"; others stay as they are.

        Raises:
            ValueError: an argument breaks its rule, or the store is open read-only or closed.
            OSError: the disk is full or cannot be written. All that was stored before is unchanged.
        """
        with self.transaction(attributes, arrays) as write:
            write(tiles, values)

    def transaction(
        self, attributes: Mapping[str, Any], arrays: Arrays | None = None, note: Note | None = None
    ) -> AbstractContextManager[Callable[[Sequence[Tile] | NDArray, ArrayLike], None]]:
        """Yield a function that writes tiles, as of `SiteStore`."""
        raise NotImplementedError

    def close(self) -> None:
        """Let others write."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
