"""`torchelev site`: the group of its commands. Each command's work is done in a module of its own."""

from __future__ import annotations

import click

from torchelev.app.site import version_commands
from torchelev.app.site.export_command import export_command
from torchelev.app.site.import_command import import_command
from torchelev.app.site.serve_options import serve_command


@click.group("site", short_help="Serve, list, go back to and export a site map.")
def site_command() -> None:
    """Work with a site map: the world map of many robots, as `SiteMap(path=...)` keeps it.

    SITE is its folder, or s3://bucket/prefix with what the environment says of S3: AWS_ACCESS_KEY_ID,
    AWS_SECRET_ACCESS_KEY, AWS_REGION and AWS_ENDPOINT_URL.
    """


for command in version_commands.COMMANDS:
    site_command.add_command(command)
site_command.add_command(export_command)
site_command.add_command(import_command)
site_command.add_command(serve_command)
