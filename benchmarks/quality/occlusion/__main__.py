"""Count how often each rule for unknown ground distinguishes a safe occlusion from a drop.

    python -m benchmarks.quality.occlusion

A robot walks up to ground that it cannot see. Behind a hump, below a brow or a low step the ground continues; at a
trench and at cliffs it drops. Four rules plan a path to a goal beyond, with the same planner on the same maps: the
inclination to the upper bound (`traversal_cost`), two ways of inpainting, and unknown ground as impassable. Counted is
how often each is right, by distance and over the whole walk. Also measured is the cost of paths between boxes before
and after their refinement.

Writes occlusion.json and occlusion.png, which shows one safe occlusion and two drops.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import click
import torch
from tqdm import tqdm

from benchmarks import RESULTS
from benchmarks.quality.occlusion.occlusion_figure import draw
from benchmarks.quality.occlusion.refine import refined_costs
from benchmarks.quality.occlusion.rules import RULES, decide
from benchmarks.quality.occlusion.scenes import KINDS, VIEWS, Case, views
from torchelev import ElevationMap
from torchelev.app.results import markdown_table, write_json

PICTURED = (("hump", 0.8), ("cliff", 0.4), ("abyss", 0.5))  # kind, and its size within the range from 0 to 1
_PICTURED_AT = 1.2  # [m] before the edge
Rows = list[dict[str, Any]]


def _trials(each: int, seed: int) -> Iterator[Rows]:
    """Yield the decisions of every rule at every view, scene by scene, for `each` random scenes of each kind."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(each):
        for make in KINDS:
            case = make(torch.rand(2, generator=generator, dtype=torch.float64).tolist())
            rows = []
            for view, (emap, x) in views(case, generator).items():
                for rule, path in decide(emap, x, case.goal).items():
                    goes = bool(path.reached[0])
                    rows.append({"kind": case.kind, "safe": case.safe, "view": view, "rule": rule, "goes": goes})
            yield rows


def _summarize(scenes: list[Rows]) -> dict[str, Any]:
    """Return how often each rule is right [%], by kind of ground and distance, and over whole walks.

    At one distance, a rule is right if it finds a path exactly where the ground is safe. Over a whole walk, it is right
    if it finds a path at every view of safe ground, and none at some view of a drop.
    """
    result: dict[str, Any] = {}
    for rule in RULES:
        for kind in dict.fromkeys(rows[0]["kind"] for rows in scenes):
            walks = [[row for row in rows if row["rule"] == rule] for rows in scenes if rows[0]["kind"] == kind]
            rates = {f"{v} m": _percent([row["goes"] == row["safe"] for w in walks for row in w if row["view"] == v])
                      for v in VIEWS}  # fmt: skip
            walk_rate = _percent([all(row["goes"] for row in walk) == walk[0]["safe"] for walk in walks])
            result.setdefault(rule, {})[kind] = rates | {"whole walk": walk_rate}
    return result


def _percent(right: list[bool]) -> float:
    return round(100 * sum(right) / len(right), 1)


def table(right: dict[str, Any]) -> str:
    """Tabulate how often each rule is right."""
    rows = [
        [rule, kind, *(f"{rate:.0f}" for rate in rates.values())]
        for rule, kinds in right.items()
        for kind, rates in kinds.items()
    ]
    return markdown_table(["rule", "ground", *(f"{v} m" for v in VIEWS), "whole walk"], rows)


def _pictured(kind: str, size: float) -> tuple[Case, ElevationMap, float]:
    """Return a scene of the figure, its map and the robot's x [m]."""
    (make,) = (make for make in KINDS if make.__name__ == kind)
    case = make([size, size])
    emap, x = views(case, torch.Generator().manual_seed(0))[_PICTURED_AT]
    return case, emap, x


@click.command(help=__doc__)
@click.option("--each", default=12, show_default=True, help="Random scenes of each kind of ground.")
@click.option("--seed", default=0, show_default=True, help="Seed of scenes and noise.")
def main(each: int, seed: int) -> None:
    """Measure, write JSON and figure and print the table."""
    scenes = list(tqdm(_trials(each, seed), total=each * len(KINDS), unit="scene"))
    right = _summarize(scenes)
    values = {"each": each, "seed": seed, "right [%]": right, "cost of ways between crates [m]": refined_costs()}
    write_json(RESULTS / "occlusion.json", values)
    pictured = [_pictured(*choice) for choice in PICTURED]
    draw(RESULTS / "occlusion.png", [(case, emap, x, decide(emap, x, case.goal)) for case, emap, x in pictured])
    click.echo(table(right))
    click.echo(values["cost of ways between crates [m]"])


if __name__ == "__main__":
    main()
