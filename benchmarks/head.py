"""What the heads cost: `python -m benchmarks.head`

A compiled update of 43,074 points on 250 x 250 cells with the analytic head and with the learned one, in turn; two CPU
threads. Writes benchmarks/results/head.json. The learned head may take at most 4 ms more.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from benchmarks.meter import interleaved
from benchmarks.report import markdown_table, write_json
from benchmarks.workload import BPEARL, Drive, full_config
from torchelev import LearnedTraversabilityConfig

RESULTS = Path(__file__).parent / "results"


def measure(seconds: float) -> dict[str, Any]:
    """Time updates with each head."""
    cfg = full_config()
    learned = replace(cfg, traversability=LearnedTraversabilityConfig())
    drives = {"analytic": Drive(cfg, BPEARL), "learned": Drive(learned, BPEARL)}
    for drive in drives.values():
        drive.warm_up()
    return interleaved(drives, seconds, rounds=20)


def table(rows: dict[str, Any]) -> str:
    """Tabulate milliseconds, and what the learned head takes more."""
    lines = [[name, f"{row['median']:.1f}", f"{row['min']:.1f}"] for name, row in rows.items()]
    more = [f"{rows['learned'][kind] - rows['analytic'][kind]:.1f}" for kind in ("median", "min")]
    return markdown_table(["head", "median ms of an update", "min ms"], [*lines, ["learned, more", *more]])


@click.command()
@click.option("--seconds", default=20.0, show_default=True, help="For each head.")
def main(seconds: float) -> None:
    """Time updates with the analytic and the learned head."""
    rows = measure(seconds)
    write_json(RESULTS / "head.json", {"rows": rows})
    click.echo(table(rows))


if __name__ == "__main__":
    main()
