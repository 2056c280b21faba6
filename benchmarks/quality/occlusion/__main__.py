"""Count how often each rule for unknown ground distinguishes ground that goes on from a drop.

    python -m benchmarks.quality.occlusion

A robot walks up to ground that it cannot see. Behind a hump, a curb or tall grass, and below a brow, a low step or
stairs, the ground goes on; at a ditch, a trench and cliffs it drops, and a glass wall stands in the way. The planner
plans a path to a goal beyond, on the same maps with each rule for unknown ground. Counted is how often each is right,
by distance and over the whole walk, and how often the height that a rule predicts close behind an edge is within 3 cm
of the ground. The rule "true ground" plans on a map that knows all. Also measured is the cost of paths between boxes
before and after their refinement.

Writes occlusion.json and occlusion.png, which shows one safe occlusion and two drops.
"""

from __future__ import annotations

from collections.abc import Iterator

import click
import torch
from tqdm import tqdm

from benchmarks import RESULTS
from benchmarks.quality.occlusion.footholds import score
from benchmarks.quality.occlusion.occlusion_figure import draw
from benchmarks.quality.occlusion.refine import refined_costs
from benchmarks.quality.occlusion.report import Trial, decisions, footholds, table
from benchmarks.quality.occlusion.rules import PREDICTED, RULES, decide
from benchmarks.quality.occlusion.scenes import KINDS, Case
from benchmarks.quality.occlusion.walks import views
from torchelev import ElevationMap
from torchelev.app.results import write_json

PICTURED = (("hump", 0.8), ("cliff", 0.4), ("abyss", 0.5))  # kind, and its size within the range from 0 to 1
_PICTURED_AT = 1.2  # [m] before the edge


def _trials(each: int, seed: int) -> Iterator[Trial]:
    """Yield the decisions of every rule at every view, scene by scene, for `each` random scenes of each kind."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(each):
        for make in KINDS:
            case = make(torch.rand(2, generator=generator, dtype=torch.float64).tolist())
            yield _try(case, generator)


def _try(case: Case, generator: torch.Generator) -> Trial:
    goes: dict[str, list[bool]] = {rule: [] for rule in RULES}
    unknown, close = 0, dict.fromkeys(PREDICTED, 0)
    for emap, x in views(case, generator).values():
        for rule, path in decide(emap, x, case).items():
            goes[rule].append(bool(path.reached[0]))
        if case.edges:
            cells, right = score(emap, case)
            unknown += cells
            close = {rule: close[rule] + right[rule] for rule in PREDICTED}
    return Trial(case, goes, unknown, close)


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
    trials = list(tqdm(_trials(each, seed), total=each * len(KINDS), unit="scene"))
    right, predicted = decisions(trials), footholds(trials)
    values = {"each": each, "seed": seed, "right [%]": right, "footholds within 3 cm [%]": predicted}
    write_json(RESULTS / "occlusion.json", values | {"cost of ways between crates [m]": refined_costs()})
    pictured = [_pictured(*choice) for choice in PICTURED]
    draw(RESULTS / "occlusion.png", [(case, emap, x, decide(emap, x, case)) for case, emap, x in pictured])
    click.echo(table(right, predicted))


if __name__ == "__main__":
    main()
