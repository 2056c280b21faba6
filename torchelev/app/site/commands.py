"""`torchelev site`: the group of its commands. Each command's work is done in a module of its own."""

from __future__ import annotations

import click


@click.group("site", short_help="Serve, list and export a site map.")
def site_command() -> None:
    """Work with a site map: the world map of many robots, as `SiteMap(path=...)` keeps it."""
