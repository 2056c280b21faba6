"""`torchelev fleet`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from torchelev.app.user_error import user_errors

_FLEET_HELP = """Let simulated robots explore a terrain together; merge what they see into one map.

All robots share one batched ElevationMap. Each of them walks to the frontiers
of what is known, around what is too steep, and has its own error of height,
up to 15 cm, which also drifts. Once a second their maps become part of a site
map, which finds these offsets from the ground that they have in common.

\b
  torchelev fleet                                 16 robots, 60 x 60 m
  torchelev fleet --robots 4 --size 30 --seed 7
  torchelev fleet --site hill/                    keep the map, go on later
  torchelev fleet --live                          watch it grow in the browser

With --service, each robot sends its map over the network of this machine to
a merger in a process of its own, as of `torchelev site serve`, and what is
shown and planned is what comes back.

The mission ends when nothing is left to explore, or after --seconds. Ctrl-C
ends it earlier and keeps what was mapped.

\b
Output files:
  fleet.png   ground truth, site map, its error, and the robots' paths
  fleet.json  the numbers, with those of each robot and of each merge
"""


@click.command("fleet", help=_FLEET_HELP, short_help="Map a simulated site with many robots at once.")
@click.option("--robots", type=int, default=16, show_default=True, metavar="N", help="Number of robots.")
@click.option("--size", type=float, default=60.0, show_default=True, metavar="M", help="Side of the square area [m].")
@click.option("--resolution", type=float, default=0.1, show_default=True, metavar="M", help="Cell size [m].")
@click.option(
    "--seconds", type=float, default=120.0, show_default=True, metavar="S", help="Simulated time at most [s]."
)
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the terrain and of all errors.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("fleet.png"),
    show_default=True,
    help="Picture to write; the numbers lie beside it as .json.",
)
@click.option(
    "--site",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Keep the site map there. One that is there is continued: give the same --seed, --size and --resolution. "
    "Needs torchelev[site].  [default: a temporary folder]",
)
@click.option("--live", is_flag=True, help="Show the growing map in the browser; needs torchelev[view].")
@click.option(
    "--service/--no-service",
    default=None,
    help="Merge in another process, over Zenoh; needs torchelev[serve].  [default: with --live, if that is installed]",
)
@click.option(
    "--host", default="127.0.0.1", show_default=True, help="Address of --live; 0.0.0.0 lets other machines connect."
)
@click.option("--port", type=click.IntRange(1, 65535), default=8080, show_default=True, help="Port of --live.")
@click.option("--quiet", is_flag=True, help="Hide the progress bar.")
def fleet_command(quiet: bool, **options: Any) -> None:
    """Run `torchelev fleet`; its help text is `_FLEET_HELP`."""
    from torchelev.app.fleet.command import run_fleet
    from torchelev.app.fleet.request import FleetRequest

    with user_errors():
        request = FleetRequest(**options)
    sys.exit(run_fleet(request, quiet))
