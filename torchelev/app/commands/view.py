"""`torchelev view`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from torchelev.app.commands.map import map_command
from torchelev.app.mapping.map_request import MapRequest
from torchelev.app.option_groups import GroupedCommand, GroupedOption
from torchelev.app.user_error import user_errors
from torchelev.viz.live.server import address_of, open_server, stop_server

_VIEW_HELP = """Show a map in the browser while it grows.

RECORDING is a folder of scans or a bag, as of `torchelev map`, with the same
options; or a map that was saved, .npz. Without it, a simulated walk is shown.

\b
  torchelev view                   the demo's walk
  torchelev view drive.mcap        a bag
  torchelev view drive/            a folder of scans with poses
  torchelev view map.npz           a saved map

The page plays the recording, pauses, steps and goes back. It colours the
surface by any layer, shows cloud, frames, path and planes, and the values of
the cell that is clicked. Ctrl-C closes it.
"""


def _run_view(recording: Path | None, host: str, port: int, paused: bool, **options: Any) -> None:
    """Run `torchelev view`; its help text is `_VIEW_HELP`."""
    request = None if recording is None else MapRequest(recording=recording, **options)
    with user_errors():
        server = open_server("demo" if recording is None else recording.resolve().name, host, port)
        try:
            if recording is None or recording.exists():  # else all that follows is an error
                click.echo(f"open      {address_of(server)}   (Ctrl-C ends)")
            from torchelev.app.view_command import run_view  # imports torch, while browsers load the page

            run_view(request, server, paused)
        except KeyboardInterrupt:
            click.echo("closed")
        finally:
            stop_server(server)


_OUTPUTS = ("recording", "out", "grid_map", "video", "every")  # parameters of `map` that `view` lacks
_PAGE = "Page"
_VIEW_OPTIONS: list[click.Parameter] = [
    click.Argument(["recording"], type=click.Path(path_type=Path), required=False),
    GroupedOption(
        ["--host"],
        group=_PAGE,
        default="127.0.0.1",
        show_default=True,
        help="Address of the page; 0.0.0.0 lets other machines connect.",
    ),
    GroupedOption(
        ["--port"],
        group=_PAGE,
        type=click.IntRange(1, 65535),
        default=8080,
        show_default=True,
        help="Port of the page.",
    ),
    GroupedOption(["--paused"], group=_PAGE, is_flag=True, help="Wait at the first scan."),
    *(parameter for parameter in map_command.params if parameter.name not in _OUTPUTS),
]
view_command = GroupedCommand(
    "view", params=_VIEW_OPTIONS, callback=_run_view, help=_VIEW_HELP, short_help="Show a map in the browser."
)
