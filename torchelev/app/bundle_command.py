"""`torchelev export` and `torchelev check`: the bundle that brings a trained policy to a robot."""

from __future__ import annotations

import ctypes
from pathlib import Path

import click

from torchelev.app.user_error import user_errors

DIFFERS = 1  # exit code


def run_export(run: Path, out: Path) -> None:
    """Make a bundle and report it; bad input becomes a one-line click error."""
    from torchelev.runtime.bundle.bundle import export_bundle

    with user_errors():
        bundle = export_bundle(run, out)
    click.echo(
        f"wrote {out}: {bundle.num_steps} steps of the groups {', '.join(bundle.groups)}; now: torchelev check {out}"
    )


def run_check(folder: Path, library: Path | None) -> int:
    """Compare, report, and return the exit code; bad input becomes a one-line click error."""
    from torchelev.runtime.bundle.bundle import read_bundle
    from torchelev.runtime.bundle.check import check_bundle

    code = 0
    with user_errors():
        for result in check_bundle(read_bundle(folder), _library(library)):
            word = {True: "same", False: "DIFFERS", None: "not compared"}[result.passed]
            click.echo(f"{word}: {result.name}: {result.text}")
            code = DIFFERS if result.passed is False else code
    return code


def _library(path: Path | None) -> ctypes.CDLL | None:
    """Return the library of a path, or this package's own; None if that cannot be built."""
    from torchelev.runtime.library import build_library, open_library

    if path is not None:
        return open_library(path)
    try:
        return build_library()
    except RuntimeError:
        return None
