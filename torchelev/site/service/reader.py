"""Reading the site of a merger from anywhere on the network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from torchelev.io.export import SavedMap
from torchelev.site.areas import place_area, save_area
from torchelev.site.service.questions import Areas, ask_areas, read_answer
from torchelev.site.service.wire.access import check_name
from torchelev.site.service.wire.messages import MessageError, decode
from torchelev.site.service.wire.transport import Channel, open_channel

if TYPE_CHECKING:
    from typing_extensions import Self

HEIGHTS = ("elevation", "variance", "time", "upper_bound")


class SiteReader:
    """Reads areas of a site that a merger serves, and learns of its new versions.

    Args:
        site: name of the site on the network.
        connect: where a merger or a Zenoh router listens, such as "tcp/127.0.0.1:7450".
        config: file of Zenoh's own configuration, for TLS and users, in place of `connect`.
        channel: to send by in place of Zenoh, which `connect` and `config` are of.
        on_version: called with each new version, in a thread of the network; None: nobody.

    Raises:
        ValueError: the name has other characters than letters, digits, _ . and -.
        ModuleNotFoundError: eclipse-zenoh is missing.
    """

    def __init__(
        self,
        site: str = "site",
        *,
        connect: str | Sequence[str] | None = None,
        config: str | Path | None = None,
        channel: Channel | None = None,
        on_version: Callable[[str], None] | None = None,
    ) -> None:
        self._version, self.on_version = "", on_version
        self._channel = open_channel(check_name("site", site), connect, config) if channel is None else channel
        self._channel.start(self._receive, self._on_merger)

    @property
    def version(self) -> str:
        """The newest version of the site that is known here; "" before the first."""
        return self._version

    def _receive(self, payload: bytes) -> None:
        """Handle what the network delivers."""
        try:
            header = decode(payload).header
        except MessageError:
            return
        if header.get("kind") == "version":
            self._set_version(str(header.get("version")))

    def _set_version(self, version: str) -> None:
        if version and version != self._version:
            self._version = version
            if self.on_version is not None:
                self.on_version(version)

    def _on_merger(self) -> None:
        """Called when a merger appears."""

    def areas(
        self, corner: Sequence[Sequence[int]], height: int, width: int, layers: Sequence[str], timeout: float = 5.0
    ) -> Areas:
        """Return layers of B areas of height x width cells, whose first cells have these numbers on the lattice.

        Raises:
            ValueError: there is no such layer, or the areas are too large to send.
            TimeoutError: no merger has answered within `timeout` [s].
        """
        answer = self._channel.ask(ask_areas(corner, height, width, layers), timeout)
        if answer is None:
            hint = "is `torchelev site serve` running, and is `connect` where it listens?"
            raise TimeoutError(f"site: a merger must answer within {timeout:g} s, got nothing; {hint}")
        areas = read_answer(answer)
        self._set_version(str(areas.about["version"]))
        return areas

    def window(
        self,
        center: Sequence[float],
        length_x: float,
        length_y: float,
        layers: Sequence[str] = HEIGHTS,
        timeout: float = 5.0,
    ) -> SavedMap:
        """Return an area of the site, as `SiteMap.window` does.

        Args:
            center: x, y [m], map frame; the area's centre is the nearest point at which its cells line up.
            length_x: [m], a whole number of cells.
            length_y: [m], a whole number of cells.
            layers: names.
            timeout: [s] to wait for the answer.

        Returns:
            The layers (H, W), NaN where unknown, and their geometry.

        Raises:
            ValueError: there is no such layer, a length is not a whole number of cells, or the area is too large.
            TimeoutError: no merger has answered.
        """
        resolution = float(self.areas([], 1, 1, [], timeout).about["resolution"])
        corner, size = place_area(center, length_x, length_y, resolution)
        found = self.areas([corner], *size, layers, timeout).layers
        return save_area({name: values[0] for name, values in found.items()}, corner, size, resolution)

    def close(self) -> None:
        """Leave the network."""
        self._channel.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
