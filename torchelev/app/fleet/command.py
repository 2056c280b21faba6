"""`torchelev fleet`: run a mission, draw it and report its numbers."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np
from tqdm import tqdm

from torchelev.app.fleet.mission import Mission
from torchelev.app.fleet.numbers import FleetNumbers, assess, compare
from torchelev.app.fleet.request import FleetRequest
from torchelev.app.interrupts import defer_interrupts
from torchelev.app.results import write_json
from torchelev.app.user_error import user_errors

if TYPE_CHECKING:
    from torchelev.app.fleet.live import FleetView

_INTERRUPTED = 130  # exit code


def run_fleet(request: FleetRequest, quiet: bool = False) -> int:
    """Run `torchelev fleet` and return its exit code; bad input becomes a one-line click error.

    Args:
        request: what to simulate.
        quiet: hide the progress bar.
    """
    with user_errors(), site_folder(request) as folder:
        request.require_outputs()
        view, mission = open_view(request), Mission(request, folder)
        with closing(mission.site):
            if request.is_served:
                click.echo("merger    a process of its own, to which each robot sends over the loopback")
            is_interrupted = explore_and_report(mission, view, quiet)
        if view and not is_interrupted:
            hold(view)
        return _INTERRUPTED if is_interrupted else 0


def explore_and_report(mission: Mission, view: FleetView | None, quiet: bool) -> bool:
    """Run the mission, write and print what it gave, and return whether Ctrl-C ended it."""
    request, start = mission.request, time.perf_counter()
    is_interrupted = explore(mission, view, quiet)
    if mission.saved is None:
        click.echo("interrupted: nothing was mapped yet", err=True)
        return True
    with defer_interrupts():
        click.echo(finish(mission, start))
        click.echo(f"wrote {request.out}  {request.numbers}" + (f"  {request.site}" if request.site else ""))
    if is_interrupted:
        click.echo(f"interrupted: kept the map of {mission.time:.0f} of {request.seconds:.0f} s", err=True)
    return is_interrupted


@contextmanager
def site_folder(request: FleetRequest) -> Iterator[Path | None]:
    """Yield the folder of the site map; a temporary one is removed at the end. None: keep it in memory."""
    if request.site is not None or find_spec("tensorstore") is None:
        yield request.site
        return
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder) / "site"


def open_view(request: FleetRequest) -> FleetView | None:
    """Open the page of the live view, if one was asked for."""
    if not request.live:
        return None
    from torchelev.app.fleet.live import FleetView

    view = FleetView(request.host, request.port)
    click.echo(f"open      {view.page.url}")
    return view


def explore(mission: Mission, view: FleetView | None, quiet: bool) -> bool:
    """Run the mission to its end and return whether Ctrl-C ended it earlier; a scan begun is completed."""
    with tqdm(total=round(mission.request.seconds), unit="s", desc="exploring", disable=quiet) as bar:
        try:
            while not mission.is_done:
                with defer_interrupts():
                    mission.step()
                    if view:
                        view.show(mission)
                show_progress(bar, mission)
        except KeyboardInterrupt:
            return True
    return False


def show_progress(bar: tqdm, mission: Mission) -> None:
    """Show simulated time, coverage and the time of the last merge."""
    progress = {
        "coverage": f"{100 * mission.coverage:.1f} %",
        "robots": len(mission.robots),
        "merge": f"{mission.merge_ms[-1]:.0f} ms",
    }
    bar.set_postfix(progress, refresh=False)
    bar.update(int(mission.time + 1e-6) - bar.n)


def finish(mission: Mission, start: float) -> FleetNumbers:
    """Merge what was seen since the last merge; write picture and numbers, and return the latter.

    Args:
        mission: that has ended.
        start: when it began, by the performance counter [s].
    """
    from torchelev.app.fleet.mission_picture import draw_fleet

    mission.finish()
    wall_seconds = time.perf_counter() - start
    comparison = compare(mission)
    numbers = assess(mission, comparison, wall_seconds)
    draw_fleet(mission.request.out, comparison, np.array(mission.robots.tracks), numbers)
    write_json(mission.request.numbers, numbers.to_dict())
    return numbers


def hold(view: FleetView) -> None:
    """Keep the page open until Ctrl-C."""
    click.echo("the page stays open until Ctrl-C")
    try:
        view.page.wait()
    except KeyboardInterrupt:
        view.page.stop()
