"""`torchelev map`."""

from __future__ import annotations

import sys
from typing import Any

import click

from torchelev.app.mapping.map_help import MAP_HELP
from torchelev.app.mapping.map_options import map_options
from torchelev.app.mapping.map_request import MapRequest
from torchelev.app.option_groups import GroupedCommand


@click.command(
    "map", cls=GroupedCommand, help=MAP_HELP, short_help="Build an elevation map from scans with poses, or a bag."
)
@map_options
def map_command(**options: Any) -> None:
    """Run `torchelev map`; its help text is `MAP_HELP`."""
    from torchelev.app.mapping.map_command import run_map

    sys.exit(run_map(MapRequest(**options)))
