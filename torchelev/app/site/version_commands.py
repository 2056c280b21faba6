"""`torchelev site log`, `tag`, `rollback`, `compact` and `convert`: the versions of a site."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from torchelev.app.user_error import user_errors

if TYPE_CHECKING:
    from torchelev.site import SiteMap

_SITE = click.argument("site")


@click.command("log", short_help="List the versions of a site.")
@_SITE
@click.option("--number", "-n", type=click.IntRange(min=1), metavar="N", help="List the newest N alone.")
def log_command(site: str, number: int | None) -> None:
    """List the versions of SITE, the newest first: id, time, what was merged, and tags.

    Behind those of its history come versions that tags alone keep, such as those before a rollback.
    """
    with _open(site, read_only=True) as opened:
        for version in opened.versions()[:number]:
            click.echo(version)


@click.command("tag", short_help="Name a version of a site.")
@_SITE
@click.argument("name")
@click.option("--version", metavar="ID", help="Id or tag of the version.  [default: the newest]")
def tag_command(site: str, name: str, version: str | None) -> None:
    """Give a version of SITE a NAME, which opens it and keeps it."""
    with _open(site) as opened:
        opened.tag(name, version)
        named = opened.version if version is None else version
    click.echo(f"{name} is {named}")


@click.command("rollback", short_help="Go back to an earlier version of a site.")
@_SITE
@click.argument("version")
def rollback_command(site: str, version: str) -> None:
    """Make SITE what it was at VERSION, an id or tag. The present version stays, with a tag.

    Robots whose measurements are taken back must reset their maps before they merge again.
    """
    with _open(site) as opened:
        kept = opened.rollback(version)
        now = opened.version
    click.echo(f"now {now}; what was the newest version is {kept}" if kept else f"{version} is the newest version")


@click.command("compact", short_help="Drop old versions of a site.")
@_SITE
@click.option(
    "--keep", type=click.IntRange(min=1), default=100, show_default=True, metavar="N", help="Versions to keep."
)
def compact_command(site: str, keep: int) -> None:
    """Drop all versions of SITE but the newest ones and those with tags, and free their space."""
    with _open(site) as opened:
        freed = opened.compact(keep)
        number = len(opened.versions())
    left = "1 version is left" if number == 1 else f"{number} versions are left"
    click.echo(f"{left}; {freed / 1e6:.1f} MB became free")


@click.command("convert", short_help="Copy a site to another engine or place.")
@_SITE
@click.argument("new")
@click.option("--version", metavar="ID", help="Id or tag of the version to copy.  [default: the newest]")
@click.option(
    "--engine",
    type=click.Choice(["icechunk", "files"]),
    default="icechunk",
    show_default=True,
    help="icechunk: with versions, for several writers; files: small, for one writer.",
)
@click.option("--quiet", is_flag=True, help="Hide the progress bar.")
def convert_command(site: str, new: str, version: str | None, engine: str, quiet: bool) -> None:
    """Copy one version of SITE to NEW, an empty or new folder or s3://bucket/prefix. SITE stays as it is."""
    with user_errors():
        from tqdm import tqdm

        from torchelev.site.storage.convert import convert

        def show(groups: list) -> tqdm:
            return tqdm(groups, "copying", unit="group", disable=quiet or None, leave=False)

        number = convert(site, new, version=version, engine=engine, show=show)  # type: ignore[arg-type]
    click.echo(f"copied {number:,} tiles to {new}")


@contextmanager
def _open(site: str, *, read_only: bool = False) -> Iterator[SiteMap]:
    with user_errors():
        from torchelev.site import SiteMap

        with SiteMap.open(site, read_only=read_only) as opened:
            yield opened


COMMANDS = (log_command, tag_command, rollback_command, compact_command, convert_command)
