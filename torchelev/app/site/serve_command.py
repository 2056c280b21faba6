"""`torchelev site serve`: hold a site map and merge what robots send."""

from __future__ import annotations

import signal
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import click

from torchelev.app.user_error import user_errors

if TYPE_CHECKING:
    from torchelev.site.service.server.merger import Merged

_REFRESH = 1.0  # [s] between lines


@dataclass
class ServeRequest:
    """Arguments of `torchelev site serve`; see its help."""

    path: str  #: folder or URL of the site
    resolution: float | None  #: [m] of a new one; None: 0.1
    name: str  #: of the site on the network
    listen: tuple[str, ...]  #: endpoints of Zenoh
    connect: tuple[str, ...]  #: endpoints of routers and other machines
    zenoh_config: Path | None  #: file of Zenoh's own configuration
    robots: Path | None  #: file of the robots' keys
    align: bool  #: find the robots' height offsets
    quiet: bool  #: print no line for each merge


@dataclass
class _Lines:
    """Prints what the merger does, one line a second at most."""

    robots: Counter[str] = field(default_factory=Counter)  # messages of each
    cells: int = 0  # new ones since the last line
    last: float = 0.0  # [s] of the last line

    def show(self, merged: Merged) -> None:
        """Count a merge, and print a line if it is time to."""
        self.robots.update(merged.robots)
        self.cells += merged.new_cells
        now = time.monotonic()
        if now - self.last >= _REFRESH:
            names = f"{len(self.robots)} robot" + "s" * (len(self.robots) != 1)
            numbers = f"{names}  {self.cells:,} new cells  {1e3 * merged.seconds:.0f} ms"
            click.echo(f"{time.strftime('%H:%M:%S')}  version {merged.version}  {numbers}")
            self.robots.clear()
            self.cells, self.last = 0, now


@contextmanager
def ended_by_signals() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C and SIGTERM set, so that a merge begun is completed."""
    event, previous = threading.Event(), {}
    for number in (signal.SIGINT, signal.SIGTERM):
        previous[number] = signal.signal(number, lambda *_: event.set())
    try:
        yield event
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def run_serve(request: ServeRequest) -> None:
    """Run `torchelev site serve` until Ctrl-C."""
    with user_errors():
        from torchelev.site.service.server.merger import SiteServer
        from torchelev.site.service.server.serve import NetworkedServer
        from torchelev.site.service.wire.access import read_keys
        from torchelev.site.service.wire.transport import import_zenoh

        import_zenoh()
        keys = None if request.robots is None else read_keys(request.robots)
        server = SiteServer(request.path, resolution=request.resolution, keys=keys, align=request.align)
        if not request.quiet:
            server.on_merge = _Lines().show
        with closing(server), ended_by_signals() as ended:
            with NetworkedServer(
                server,
                request.name,
                listen=request.listen or None,
                connect=request.connect or None,
                config=request.zenoh_config,
            ) as network:
                click.echo(f"serving   {request.path} as {request.name}  {network.endpoints}")
                network.run(ended.is_set, lambda error: click.echo(f"warning: {error}", err=True))
            click.echo(f"closed    version {server.site.version}  {_describe(server.counts)}")


def _describe(counts: Counter[str]) -> str:
    """Return the numbers of messages in words."""
    return ", ".join(f"{number} {kind}" for kind, number in counts.items() if number) or "no messages"
