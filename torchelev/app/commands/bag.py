"""`torchelev bag`."""

from __future__ import annotations

from pathlib import Path

import click

from torchelev.app.user_error import user_errors


@click.command("bag", short_help="List what a bag holds, and how to map it.")
@click.argument("bag", type=click.Path(path_type=Path))
def bag_command(bag: Path) -> None:
    """List topics, types, counts, rates and frames of BAG and its tree of transforms; propose the command to map it."""
    from torchelev.app.bag.command import describe_bag

    with user_errors():
        click.echo(describe_bag(bag))
