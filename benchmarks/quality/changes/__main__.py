"""Count the scans until new obstacles show in the map, and the cells that people who left leave behind.

    python -m benchmarks.quality.changes

Robots stand still on rough ground in one batch, each with its own ground and noise.

Obstacles: after 60 s of empty ground, a box of 0.3 m, a person or a wall stands 2.5 m ahead. Counted are the scans
until half of the cells that the obstacle covers and points hit are more than 0.15 m above the ground.

Plates: the same for a plate of 3 cm and the cells whose centers it covers, until it shows to 80 % of its height, for
several rates of aging.

Ghosts: a person crosses the view four times. Counted are the cells more than 0.1 m above the ground 3 s later, and
those of them that a ray of the last scan passes below, so that the map could have cleared them.

Writes benchmarks/results/changes.json row by row; rows that are not measured keep their results.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import click
import torch
from tqdm import tqdm

from benchmarks import RESULTS
from benchmarks.quality.changes.ghosts import HERTZ, ghosts
from benchmarks.quality.changes.obstacles import FRACTIONS, RATES, SETTLED, obstacle_scans, plate_scans
from benchmarks.quality.changes.report import tables
from benchmarks.quality.changes.world import SENSORS
from torchelev.app.results import commit, write_json

SECTIONS = ("obstacles", "plates", "ghosts")


class Measures(NamedTuple):
    """What measures a row of each section."""

    obstacles: Callable[..., dict[str, Any]] = obstacle_scans
    plates: Callable[..., dict[str, Any]] = plate_scans
    ghosts: Callable[..., dict[str, Any]] = ghosts


def _rows(
    seeds: int, settled: int, hertz: tuple[int, ...], compiled: bool, by: Measures
) -> Iterator[tuple[str, str, Callable[[], dict[str, Any]]]]:
    """Yield section, name and measurement of every row."""
    camera, settings = SENSORS["camera 120 x 90"], (seeds, settled, compiled)
    for name, fractions in FRACTIONS.items():
        for fraction in fractions:
            measure = partial(by.obstacles, camera, name, fraction, *settings)
            yield "obstacles", f"{name}, {fraction:.1%} of the points", measure
    for rate in RATES:
        yield "plates", f"{rate:.0e}", partial(by.plates, camera, rate, *settings)
    for name, sensor in SENSORS.items():
        for frequency in hertz:
            measure = partial(by.ghosts, sensor, frequency, seeds, compiled)
            yield "ghosts", f"{name} at {frequency} Hz", measure


@click.command(help=__doc__)
@click.option("--seeds", default=50, show_default=True, help="Number of robots, each with its own ground and noise.")
@click.option("--settled", default=SETTLED, show_default=True, help="Scans of empty ground before an obstacle.")
@click.option("--only", type=click.Choice(SECTIONS), help="Measure only this section.")
@click.option(
    "--hertz", type=int, multiple=True, default=HERTZ, show_default=True, help="Scan rates for ghosts; repeat."
)
@click.option("--compiled/--eager", default=True, show_default=True, help="Compile the map's updates.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Output folder.")
@click.pass_obj
def main(
    by: Measures | None,
    seeds: int,
    settled: int,
    only: str | None,
    hertz: tuple[int, ...],
    compiled: bool,
    out: Path,
) -> None:
    """Measure, write JSON and print the tables."""
    torch.set_num_threads(2)
    path = out / "changes.json"
    result = json.loads(path.read_text()) if path.exists() else {}
    result = {name: result.get(name, {}) for name in SECTIONS}
    rows = [row for row in _rows(seeds, settled, hertz, compiled, by or Measures()) if only in (None, row[0])]
    for section, name, measure in tqdm(rows, unit="row"):
        result[section][name] = measure() | {"seeds": seeds, "settled": settled, "commit": commit()}
        write_json(path, result)
    click.echo(tables(result))


if __name__ == "__main__":
    main()
