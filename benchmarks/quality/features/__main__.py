"""Measure what each feature of the map is worth: on, off, and against the plain baseline.

    python -m benchmarks.quality.features

on: the default configuration.

off: the default with this one feature set to None (drift, raycast, overlap, fusion.edges or sensor.exclusion).

baseline: point transform, noise and height update only; everything that can be None is None.

All three map the same recording of a walk with bob, roll and pitch at 5 Hz: the scene's exact returns with range noise
(3 mm + 1.5 mm/m^2 * d^2 for the camera, 1 cm for the lidar), of which 2 % are lost. Cells are 4 cm. The truth of a
cell is the height of the ground at its center. Each metric is defined in the docstring of its function in
benchmarks/quality/features; targets are of the feature switched on.

Prints a table and writes features.json and features.png, which shows some of the maps where they differ.
"""

from __future__ import annotations

from pathlib import Path

import click

from benchmarks import RESULTS
from benchmarks.quality.features.comparison import FEATURES, HEAD, configurations, examine, table_rows
from benchmarks.quality.features.feature_figure import draw
from torchelev.app.results import machine, markdown_table, write_json


@click.command(help=__doc__)
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=RESULTS, help="Output folder.")
@click.option("--only", default="", help="Measure only the features whose name contains this text, and write nothing.")
def main(out: Path, only: str) -> None:
    """Measure, write JSON and figure and print the table."""
    measured_on = machine()  # now, because the checkout may change while this runs
    outcomes = [examine(feature) for feature in FEATURES if only in feature.name]
    rows = table_rows(outcomes)
    click.echo(markdown_table(HEAD, rows))
    failed = [f"{row[0]}: {row[1]}" for row in rows if row[-1] == "FAIL"]
    click.echo(f"\n{len(failed)} targets missed" + "".join(f"\n  {line}" for line in failed))
    if not only:
        settings = {name: cfg.to_dict() for name, cfg in configurations("raycast").items()}
        named = [dict(zip(HEAD, row, strict=True)) for row in rows]
        write_json(out / "features.json", {"machine": measured_on, "rows": named, "configs": settings})
        draw(outcomes, out / "features.png")


if __name__ == "__main__":
    main()
