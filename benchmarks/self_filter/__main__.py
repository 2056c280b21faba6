"""Measure the self-filter on a quadruped that trots, with two depth cameras of 300 points.

    python -m benchmarks.self_filter

Walking: the quadruped of envs/ trots over rough ground; how many of the points on it are removed, and how many ground
points near its feet are lost.

Legs: the points on the legs that are left, and the ground within 5 cm of the feet that is lost, by padding and depth
noise; cameras of 80 x 60 pixels, exact poses.

Speed: updates of 256 maps of 64 x 64 cells without a body, with one box, and with the 17 shapes of 13 links, in turn.

Writes benchmarks/results/self_filter.json section by section; sections that are not measured keep their results.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from benchmarks import RESULTS
from benchmarks.self_filter import legs, speed, walking
from torchelev.app.results import commit, markdown_table, write_json

Sections = dict[str, Callable[[float], dict[str, Any]]]
SECTIONS: Sections = {
    "speed": speed.measure,
    "legs": lambda _: legs.measure(),
    "walking": walking.measure,
}


def tables(result: dict[str, Any]) -> str:
    """Tabulate the sections that were measured."""
    parts = []
    if "speed" in result:
        rows = [
            [name, f"{row['median']:.1f}", f"{row['min']:.1f}", f"{row['extra']:+.1%}"]
            for name, row in result["speed"]["rows"].items()
        ]
        parts.append(markdown_table([f"{result['speed']['robots']} robots", "median ms", "min ms", "extra"], rows))
    if "walking" in result:
        parts.append(walking.table(result["walking"]))
    if "legs" in result:
        rows = [[name, f"{row['left']:.2%}", f"{row['lost']:.2%}"] for name, row in result["legs"]["rows"].items()]
        parts.append(markdown_table(["padding, noise", "leg points left", "ground at the feet lost"], rows))
    return "\n\n".join(parts)


@click.command(help=__doc__)
@click.option("--seconds", default=10.0, show_default=True, help="Time per row [s].")
@click.option("--only", type=click.Choice(list(SECTIONS)), help="Measure only this section.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Output folder.")
@click.pass_obj
def main(sections: Sections | None, seconds: float, only: str | None, out: Path) -> None:
    """Measure, write JSON and print the tables."""
    path = out / "self_filter.json"
    result = json.loads(path.read_text()) if path.exists() else {}
    for name, measure in (sections or SECTIONS).items():
        if only in (None, name):
            result[name] = measure(seconds) | {"commit": commit()}
            write_json(path, result)
    click.echo(tables(result))


if __name__ == "__main__":
    main()
