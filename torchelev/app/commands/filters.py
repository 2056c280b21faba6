"""`torchelev filters`."""

from __future__ import annotations

import click


@click.command("filters", short_help="List the filters that a config can use.")
def filters_command() -> None:
    """List the filters that a config can use, with their inputs and settings."""
    from torchelev.filters.registry import listing

    click.echo(listing())
