"""`torchelev site`: the group of its commands. Each command's work is done in a module of its own."""

from __future__ import annotations

import click

from torchelev.app.site.serve_options import serve_command


@click.group("site", short_help="Serve, list and export a site map.")
def site_command() -> None:
    """Work with a site map: the world map of many robots, as `SiteMap(path=...)` keeps it."""


site_command.add_command(serve_command)
