"""What the heads cost: `python -m benchmarks.speed.head`

A compiled update of 43,074 points on 250 x 250 cells with the analytic head and with the learned one, and the learned
head alone on the map that this made, compiled too, in turn; two CPU threads. Writes benchmarks/results/head.json.
The learned head may take 4 ms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import torch

from benchmarks.speed.meter import interleaved
from benchmarks.speed.workload import BPEARL, Drive, full_config
from torchelev import ElevationMap, LearnedTraversabilityConfig, RobotConfig, TraversabilityNet
from torchelev.app.results import markdown_table, write_json

RESULTS = Path(__file__).parents[1] / "results"


def measure(seconds: float) -> dict[str, Any]:
    """Time updates with each head."""
    cfg = full_config()
    learned = replace(cfg, traversability=LearnedTraversabilityConfig())
    drives = {"analytic": Drive(cfg, BPEARL), "learned": Drive(learned, BPEARL)}
    for drive in drives.values():
        drive.warm_up()
    return interleaved({**drives, "learned, alone": alone(drives["learned"].emap)}, seconds, rounds=20)


def alone(emap: ElevationMap) -> Callable[[], Any]:
    """Return the learned rating of a map as a compiled call, as a user would make it who needs no gradients."""
    net, robot, state = TraversabilityNet.from_pretrained().requires_grad_(False), RobotConfig(), emap.state
    layers = state.elevation, state.validity, state.variance, state.upper_bound, state.bounded
    compiled = torch.compile(lambda *given: net(*given, resolution=emap.cfg.grid.resolution, robot=robot))

    def run() -> None:
        with torch.no_grad():
            compiled(*layers)

    run()
    return run


def table(rows: dict[str, Any]) -> str:
    """Tabulate milliseconds, and what the learned head takes more."""
    lines = [[name, f"{row['median']:.1f}", f"{row['min']:.1f}"] for name, row in rows.items()]
    more = [f"{rows['learned'][kind] - rows['analytic'][kind]:.1f}" for kind in ("median", "min")]
    return markdown_table(["update with the head", "median ms", "min ms"], [*lines, ["learned, more", *more]])


@click.command()
@click.option("--seconds", default=20.0, show_default=True, help="For each.")
def main(seconds: float) -> None:
    """Time updates with the analytic and the learned head."""
    rows = measure(seconds)
    write_json(RESULTS / "head.json", {"rows": rows})
    click.echo(table(rows))


if __name__ == "__main__":
    main()
