"""Measure the C library: `speed`, `replay`, `spacing`, `processors` and `sanitize` write JSON to benchmarks/results."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from benchmarks import RESULTS
from torchelev.app.results import write_json

_OUT = click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Output folder.")


def _report(found: dict[str, Any], path: Path, table: Callable[[dict[str, Any]], str] | None = None) -> None:
    """Write what was found, and print it: as JSON, or by a function that tabulates it."""
    write_json(path, found)
    click.echo(table(found) if table else json.dumps(found, indent=2))


@click.group(help=__doc__)
def main() -> None:
    """Measure the C library."""


@main.command()
@click.option("--rounds", default=5, show_default=True, help="Rounds, in turns, whose medians are written.")
@click.option("--seconds", default=10.0, show_default=True, help="Length of the 50 Hz loops [s].")
@_OUT
def speed(rounds: int, seconds: float, out: Path) -> None:
    """Time start, updates and a loop of 50 Hz, beside Python: runtime_speed.json."""
    from benchmarks.runtime.speed import measure

    _report(measure(rounds, seconds), out / "runtime_speed.json")


@main.command()
@click.option("--seconds", default=600, show_default=True, help="How long damaged files are read [s].")
@_OUT
def sanitize(seconds: int, out: Path) -> None:
    """Replay streams and read damaged files under sanitizers: runtime_sanitizers.json."""
    from benchmarks.runtime.proofs import sanitize as prove

    _report(prove(seconds), out / "runtime_sanitizers.json")


@main.command()
@_OUT
def processors(out: Path) -> None:
    """Compare code for other processors, aarch64 emulated by qemu-user: runtime_processors.json."""
    from benchmarks.runtime.proofs import compare_processors

    _report(compare_processors(), out / "runtime_processors.json")


@main.command()
@_OUT
def replay(out: Path) -> None:
    """Map the scenes of the accuracy and feature tables by Python and by the library: runtime_replay.json."""
    from benchmarks.runtime.replay import replay as map_by_both

    _report(map_by_both(), out / "runtime_replay.json")


@main.command()
@_OUT
def spacing(out: Path) -> None:
    """Read points 0.1 m apart of maps with other cells: runtime_spacing.json."""
    from benchmarks.runtime.spacing import measure, table

    _report(measure(), out / "runtime_spacing.json", table)


if __name__ == "__main__":
    main()
