"""Time the ray casting of 256 robots among structures, with their boxes and without.

    python -m benchmarks.speed.structures

The tiles are those of a course of rooms (`CoversConfig`): walls are part of the ground, lintels, tables and beams are
boxes. Writes benchmarks/results/structures.json.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import click
import torch

from benchmarks import RESULTS
from benchmarks.speed.common import meter
from benchmarks.speed.common.workload import by_tensors
from benchmarks.speed.sensors import SENSORS, standing
from torchelev.app.results import machine, markdown_table, write_json
from torchelev.sim import CourseConfig, CoversConfig, MountedSensor, make_course

ROBOTS = 256


def measure(seconds: float, robots: int = ROBOTS, tiles: int = 64) -> list[dict[str, Any]]:
    """Time all cases in turn, in C++ and by tensors."""
    course = make_course(CourseConfig(num_tiles=tiles, covers=CoversConfig()))
    structures = course.structures
    assert structures is not None
    ids, T = standing(course.field, robots)

    def cast(sensor: MountedSensor, has_boxes: bool, is_native: bool) -> torch.Tensor:
        boxes, step = structures.boxes(ids) if has_boxes else None, torch.zeros_like(ids)
        if is_native:
            return sensor(course.field, ids, T, boxes, step=step)
        with by_tensors():
            return sensor(course.field, ids, T, boxes, step=step)

    cases = [(name, boxes, code) for name in SENSORS for boxes in (False, True) for code in ("C++", "tensors")]
    runs = {case: partial(cast, SENSORS[case[0]], case[1], case[2] == "C++") for case in cases}
    per_tile = float((structures.half_size > 0).all(-1).sum()) / tiles
    return [
        {"sensor": name, "boxes": per_tile * boxes, "code": code, "robots": robots, **row}
        for (name, boxes, code), row in meter.interleaved(runs, seconds).items()
    ]


def table(result: dict[str, Any]) -> str:
    """Tabulate the times [ms]."""
    head = ["sensor", "boxes on a tile", "by", "median ms", "min ms", "times without"]
    plain = {(row["sensor"], row["code"]): row["median"] for row in result["rows"] if not row["boxes"]}
    lines = [
        [row["sensor"], f"{row['boxes']:.0f}", row["code"], f"{row['median']:.1f}", f"{row['min']:.1f}",
         f"{row['median'] / plain[row['sensor'], row['code']]:.2f}"]
        for row in result["rows"]
    ]  # fmt: skip
    return markdown_table(head, lines)


@click.command(help=__doc__)
@click.option("--seconds", default=4.0, show_default=True, help="Time per case [s].")
def main(seconds: float) -> None:
    """Measure, write JSON and print the table."""
    torch.set_num_threads(2)
    result = {"machine": machine(), "threads": 2, "rows": measure(seconds)}
    write_json(RESULTS / "structures.json", result)
    click.echo(table(result))


if __name__ == "__main__":
    main()
