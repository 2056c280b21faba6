"""How many pictures a second the live view makes, and how much it slows a loop down.

    python -m benchmarks.speed.live_view

Clients are processes of their own that receive what a browser would, and draw nothing. Writes
benchmarks/results/live_view.json.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import click
import torch

from benchmarks import RESULTS
from benchmarks.speed.common.meter import progress
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.app.results import markdown_table, write_json
from torchelev.sim.poses import pose
from torchelev.viz.live import LiveView, Page, take_snapshot

_PICTURE_BYTES = 50_000  # of a message, at least


@dataclass(frozen=True)
class Sizes:
    """What is measured, and how long."""

    grid: GridConfig = GridConfig(resolution=0.04, length_x=10.0, length_y=10.0)  # 250 x 250 cells
    clients: tuple[int, ...] = (1, 3)
    threads: tuple[int, ...] = (1, 2)
    periods: tuple[float, ...] = (0.0, 0.1)  # [s] of the loop; 0: without a pause
    num_points: int = 20_000
    pairs: int = 15
    seconds: float = 3.0  # of a loop
    pictures: int = 60


class Workload:
    """A map of waves whose sensor hangs 2 m above it."""

    def __init__(self, sizes: Sizes) -> None:
        self.sizes = sizes
        self.emap = ElevationMap(ElevationMapConfig(grid=sizes.grid))
        self.T = pose(torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64), torch.zeros(1))
        self._generator = torch.Generator().manual_seed(0)
        xy = self.emap.cell_centers()[0].flatten(0, 1).float()
        self.fuse(xy)

    def fuse(self, xy: torch.Tensor | None = None) -> None:
        """Fuse a cloud of random points, or of the given ones (N, 2)."""
        if xy is None:
            unit = torch.rand(self.sizes.num_points, 2, generator=self._generator)
            xy = self.sizes.grid.length_x * (unit - 0.5)
        z = 0.3 * torch.sin(xy[:, :1]) - 2.0
        self.emap.update(torch.cat([xy, z], -1)[None], self.T, self.T, dt=0.05)


def receive(url: str, num_pictures: Any) -> None:
    """Receive what a page sends, and count the pictures."""
    import viser
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    protocol = Subprotocol(f"viser-v{viser.__version__}")
    with contextlib.suppress(ConnectionClosed):
        with connect(url.replace("http", "ws"), max_size=None, subprotocols=[protocol]) as socket:
            while True:
                if len(socket.recv()) > _PICTURE_BYTES:
                    num_pictures.value += 1


@contextlib.contextmanager
def connected(url: str, count: int) -> Iterator[list[Any]]:
    """Connect clients to a page; yields their numbers of pictures."""
    context = multiprocessing.get_context("spawn")  # a fork would inherit the server's threads
    counts = [context.Value("q", 0) for _ in range(count)]
    clients = [context.Process(target=receive, args=(url, value), daemon=True) for value in counts]
    try:
        for client in clients:
            client.start()
        yield counts
    finally:
        for client in clients:
            client.kill()


def measure_rate(clients: int, sizes: Sizes) -> dict[str, Any]:
    """Return pictures a second: as fast as they can be drawn, until every client has received them."""
    work = Workload(sizes)
    page = Page("benchmark", work.emap.layers)
    page.draw(take_snapshot(work.emap, work.T, work.T))
    with connected(page.url, clients) as counts:
        while any(value.value < 1 for value in counts):  # the first picture is there when a client connects
            time.sleep(0.05)
        start = time.perf_counter()
        for k in range(sizes.pictures):
            page.draw(take_snapshot(work.emap, work.T, work.T))
            while any(value.value < k for value in counts):  # at most one picture is under way
                time.sleep(0.001)
        seconds = time.perf_counter() - start
    page.stop()
    return {"clients": clients, "pictures_per_s": sizes.pictures / seconds}


def measure_slowdown(threads: int, period: float, sizes: Sizes) -> dict[str, Any]:
    """Return the time of updates in a loop with the live view by that without, median over pairs in both orders."""
    torch.set_num_threads(threads)
    work, ratios = Workload(sizes), []
    with LiveView(work.emap) as view, connected(view.page.url, 1):
        _run(work, view, period)
        num_before = view.num_drawn
        for pair in progress(range(sizes.pairs), f"slowdown, {threads} threads"):
            order = (True, False) if pair % 2 else (False, True)
            ms = {shown: _run(work, view if shown else None, period) for shown in order}
            ratios.append(ms[True] / ms[False])
        rate = (view.num_drawn - num_before) / (sizes.pairs * sizes.seconds)
    return {
        "threads": threads,
        "period_s": period,
        "ratio": median(ratios),
        "ratios": sorted(ratios),
        "pictures_per_s": rate,
        "ms": ms[False],
    }


def _run(work: Workload, view: LiveView | None, period: float) -> float:
    """Return the milliseconds of an update with `show`, in a loop; the pause is left out."""
    num_updates, busy, start = 0, 0.0, time.perf_counter()
    while time.perf_counter() - start < work.sizes.seconds:
        begin = time.perf_counter()
        work.fuse()
        if view is not None:
            view.show(work.T, work.T)
        taken = time.perf_counter() - begin
        busy, num_updates = busy + taken, num_updates + 1
        time.sleep(max(0.0, period - taken))
    return 1e3 * busy / num_updates


def table(result: dict[str, Any]) -> str:
    """Tabulate the rates by clients, and the slowdown by threads."""
    rows = [
        [f"pictures a second, {_count(row['clients'], 'client')}", f"{row['pictures_per_s']:.0f}"]
        for row in result["rates"]
    ]
    for row in result["loops"]:
        loop = f"loop at {1 / row['period_s']:.0f} Hz" if row["period_s"] else "loop without a pause"
        rows.append(
            [f"{loop}, {_count(row['threads'], 'thread')}: updates slower by", f"{100 * (row['ratio'] - 1):.1f} %"]
        )
        rows.append([f"{loop}, {_count(row['threads'], 'thread')}: pictures a second", f"{row['pictures_per_s']:.1f}"])
    return markdown_table(["250 × 250 cells", ""], rows)


def _count(number: int, of: str) -> str:
    return f"{number} {of}{'s' if number > 1 else ''}"


@click.command(help=__doc__)
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Output folder.")
@click.pass_obj
def main(sizes: Sizes | None, out: Path) -> None:
    """Measure, write JSON and print the table."""
    torch.set_num_threads(1)
    sizes = sizes or Sizes()
    rates = [measure_rate(clients, sizes) for clients in progress(sizes.clients, "clients")]
    loops = [measure_slowdown(n, period, sizes) for period in sizes.periods for n in sizes.threads]
    result = {"rates": rates, "loops": loops}
    write_json(out / "live_view.json", result)
    click.echo(table(result))


if __name__ == "__main__":
    main()
