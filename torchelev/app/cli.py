"""The command line. Each command is declared in `commands`, and its work is done in a module of its own."""

from __future__ import annotations

import click

from torchelev import __version__
from torchelev.app.commands.bag import bag_command
from torchelev.app.commands.bundle import check_command, export_command
from torchelev.app.commands.demo import demo_command
from torchelev.app.commands.filters import filters_command
from torchelev.app.commands.fleet import fleet_command
from torchelev.app.commands.map import map_command
from torchelev.app.commands.plan import plan_command
from torchelev.app.commands.view import view_command
from torchelev.app.ros2_command import ros2_command
from torchelev.app.site.commands import site_command
from torchelev.app.user_error import plain_warnings


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__)
def main() -> None:
    """Build elevation maps from point clouds and depth images."""
    click.get_current_context().with_resource(plain_warnings())


for _command in (
    *(map_command, bag_command, demo_command, fleet_command, view_command, plan_command, filters_command),
    *(export_command, check_command, ros2_command, site_command),
):
    main.add_command(_command)
