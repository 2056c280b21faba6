"""Time an update with the analytic and with the learned traversability head.

    python -m benchmarks.speed.head

Times in turn a compiled update of 43,074 points on 250 x 250 cells with each head, and the compiled learned head alone
on the resulting map. The learned head may take 4 ms. Writes benchmarks/results/head.json.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import click
import torch

from benchmarks import RESULTS
from benchmarks.speed.common.meter import interleaved
from benchmarks.speed.common.workload import BPEARL, Drive, full_config
from torchelev import ElevationMap, LearnedTraversabilityConfig, RobotConfig, TraversabilityNet
from torchelev.app.results import markdown_table, write_json


def measure(seconds: float) -> dict[str, Any]:
    """Time updates with each head."""
    cfg = full_config()
    learned = replace(cfg, traversability=LearnedTraversabilityConfig())
    drives = {"analytic": Drive(cfg, BPEARL), "learned": Drive(learned, BPEARL)}
    for drive in drives.values():
        drive.warm_up()
    runs: dict[str, Callable[[], Any]] = {**drives, "learned, alone": _alone(drives["learned"].emap)}
    return interleaved(runs, seconds, rounds=20)


def _alone(emap: ElevationMap) -> Callable[[], Any]:
    """Return a compiled call of the learned head on a map, without gradients."""
    net, robot, state = TraversabilityNet.from_pretrained().requires_grad_(False), RobotConfig(), emap.state
    layers = state.elevation, state.validity, state.variance, state.upper_bound, state.bounded
    compiled = torch.compile(lambda *given: net(*given, resolution=emap.cfg.grid.resolution, robot=robot))

    def run() -> None:
        with torch.no_grad():
            compiled(*layers)

    run()
    return run


def table(rows: dict[str, Any]) -> str:
    """Tabulate the times [ms], and how much longer the learned head takes."""
    lines = [[name, f"{row['median']:.1f}", f"{row['min']:.1f}"] for name, row in rows.items()]
    more = [f"{rows['learned'][kind] - rows['analytic'][kind]:.1f}" for kind in ("median", "min")]
    return markdown_table(["update with the head", "median ms", "min ms"], [*lines, ["learned, more", *more]])


@click.command(help=__doc__)
@click.option("--seconds", default=20.0, show_default=True, help="Time per row [s].")
def main(seconds: float) -> None:
    """Measure, write JSON and print the table."""
    rows = measure(seconds)
    write_json(RESULTS / "head.json", {"rows": rows})
    click.echo(table(rows))


if __name__ == "__main__":
    main()
