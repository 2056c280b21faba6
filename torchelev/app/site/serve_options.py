"""The options of `torchelev site serve`, and its help. Imports no PyTorch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

_HELP = """Hold the site map SITE, and merge what robots send over Zenoh.

Robots send with torchelev.site.service.RobotLink, and get what the site knows
around them. Needs torchelev[serve].

\b
  torchelev site serve hill/                            this machine alone
  torchelev site serve hill/ --listen tcp/10.0.0.5:7450
  torchelev site serve hill/ --connect tcp/127.0.0.1:7447    a router, such as rmw_zenoh's
  torchelev site serve hill/ --robots robots.yaml       only these robots may write

What the merger acknowledges is on disk. Ctrl-C ends it after the merge
that is under way; robots keep what they have until it runs again.
"""


@click.command("serve", help=_HELP, short_help="Merge what robots send over the network.")
@click.argument("path", metavar="SITE")
@click.option(
    "--resolution", type=float, metavar="M", help="Cell size of a new site [m].  [default: the site's, or 0.1]"
)
@click.option("--name", default="site", show_default=True, help="Name of the site on the network.")
@click.option(
    "--listen",
    multiple=True,
    metavar="ENDPOINT",
    help="Where robots connect; repeat it.  [default: tcp/127.0.0.1:7450, unless --connect or --zenoh-config is given]",
)
@click.option("--connect", multiple=True, metavar="ENDPOINT", help="A Zenoh router to connect to; repeat it.")
@click.option(
    "--zenoh-config",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Zenoh's own configuration, for TLS, users and access control.",
)
@click.option(
    "--robots",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="YAML with a line `name: key` for each robot that may write.  [default: all that connect may]",
)
@click.option("--align/--no-align", default=True, show_default=True, help="Find the height offset of each robot.")
@click.option("--quiet", is_flag=True, help="Print no line for each merge.")
def serve_command(**options: Any) -> None:
    """Run `torchelev site serve`; its help text is `_HELP`."""
    from torchelev.app.site.serve_command import ServeRequest, run_serve

    run_serve(ServeRequest(**options))
