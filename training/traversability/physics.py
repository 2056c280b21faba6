"""Check the labels against a physics simulation in MuJoCo.

    python -m training.traversability.physics

Stances are drawn at random on the kinds of terrain of the training and on the held-out kind, half of them labelled as
standing where possible. In each, a rigid box on four balls is put down and simulated: on the label's footholds where
the label says that the robot stands, otherwise with its feet under the body's corners, each extended towards the
ground. The robot stood if after 1.5 s it has moved by at most 7 % of its length and tilted by at most 0.1 rad, and only
its feet touched the ground. Each stance is simulated twice: with a usual friction of 0.9, and with little more than
max_slope requires.

The simulation finds footholds that do not hold, stances that tip or slide, and bodies that touch the ground. It does
not find whether a leg can lift its foot over the step between two feet, whether a body could be less steep than the
plane through its feet, whether other footholds would have held where the label says that none do, or what a controller
could do beyond stiff legs. Legs do not collide; how many straight legs would cut the ground is counted. Hence it can
show that a label is too optimistic; where a robot stood against its label, the label may be cautious or right.

Writes training/results/traversability-physics.json.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from tqdm import tqdm

from torchelev.app.results import markdown_table, write_json
from torchelev.robot import RobotConfig
from torchelev.sim import HeightField
from training import RESULTS
from training.traversability.labels.drop import drop, has_clear_legs, on_footholds, on_nominal_places
from training.traversability.labels.stances import STANDS, VERDICTS, find_stances, ground_around
from training.traversability.maps.terrain import KINDS, LENGTH, RIM, UNSEEN_KINDS, draw_robot, make_tiles
from training.traversability.robot import RobotType

_RESULT = RESULTS / "traversability-physics.json"
CANDIDATES = 400  # stances on a tile to draw from
HEADINGS = 8
_FRICTION = 0.9  # usual between rubber and stone

Row = dict[str, Any]


def rows_of_tile(field: HeightField, kind: str, robot: RobotConfig, count: int, rng: np.random.Generator) -> list[Row]:
    """Draw up to `count` stances on the first tile, half of each label, and simulate the robot in each."""
    half = LENGTH / 2 - RIM
    xy = torch.from_numpy(rng.uniform(-half, half, (CANDIDATES, 2))).float()
    theta = torch.from_numpy(rng.integers(HEADINGS, size=CANDIDATES) * (math.pi / HEADINGS)).float()
    found = find_stances(ground_around(field, 0, xy, robot), xy, theta, robot)
    stands = (found.verdict == STANDS).numpy()
    chosen = np.concatenate([np.flatnonzero(stands == label)[: count // 2] for label in (True, False)])
    rows = []
    for n in chosen.tolist():
        place = (xy[n], float(theta[n]), robot)
        posture = on_footholds(field, 0, found.feet[n], *place) if stands[n] else on_nominal_places(field, 0, *place)
        usual, limit = (drop(field, 0, posture, robot, friction) for friction in (_FRICTION, _min_friction(robot)))
        rows.append({
            "kind": kind, "verdict": VERDICTS[int(found.verdict[n])], "stood": usual.stood(robot),
            "stood_at_limit": limit.stood(robot), "legs_clear": has_clear_legs(field, 0, posture, robot),
        })  # fmt: skip
    return rows


def _min_friction(robot: RobotConfig) -> float:
    """Return the friction that max_slope requires plus 5 %, without which stances at the limit creep."""
    return 1.05 * math.tan(robot.max_slope)


def _count(rows: list[Row]) -> dict[str, float]:
    """Count how often label and simulation agree."""
    labelled_yes, labelled_no = (
        [row for row in rows if (row["verdict"] == "stands") == label] for label in (True, False)
    )
    counts: dict[str, float] = {"standing": len(labelled_yes), "not_standing": len(labelled_no)}
    for suffix in ("", "_at_limit"):
        stood = sum(row["stood" + suffix] for row in labelled_yes)
        fell = sum(not row["stood" + suffix] for row in labelled_no)
        agreement = (stood + fell) / max(1, len(rows))
        counts |= {"stood" + suffix: stood, "fell" + suffix: fell, "agreement" + suffix: agreement}
    return counts


def table(result: dict[str, Any]) -> str:
    """Tabulate the agreement by kind of terrain, and for stances that labels refuse by the failed criterion."""
    head = ["", "labelled standing", "stood", "at the limit", "labelled not", "fell", "at the limit", "agreement",
            "at the limit"]  # fmt: skip
    names = ("standing", "stood", "stood_at_limit", "not_standing", "fell", "fell_at_limit")
    stopped = {f"stopped by {v}": s for v, s in result["by_verdict"].items() if v != "stands"}
    lines = []
    for name, s in (result["by_kind"] | stopped | {"all": result["all"]}).items():
        percentages = (f"{100 * s[key]:.1f} %" for key in ("agreement", "agreement_at_limit"))
        lines.append([name, *(str(s[key]) for key in names), *percentages])
    return markdown_table(head, lines)


def summarize(rows: list[Row]) -> dict[str, Any]:
    """Count the agreement over all stances, by kind of terrain and by verdict."""
    by = {
        name: {value: _count([r for r in rows if r[name] == value]) for value in dict.fromkeys(r[name] for r in rows)}
        for name in ("kind", "verdict")
    }
    standing = [row for row in rows if row["verdict"] == "stands"]
    legs = sum(row["legs_clear"] for row in standing) / max(1, len(standing))
    return {"all": _count(rows), "legs_clear": legs, "by_kind": by["kind"], "by_verdict": by["verdict"]}


@click.command(help=__doc__)
@click.option("--tiles", type=click.IntRange(1), default=10, show_default=True, help="Tiles of each kind of terrain.")
@click.option(
    "--drops", type=click.IntRange(2), default=8, show_default=True, help="Largest number of stances per tile."
)
@click.option("--robot", type=RobotType(), help="length=0.7,width=0.4,... or a YAML file. Default: random.")
@click.option("--seed", default=0, show_default=True, help="Seed of terrain, robots and stances.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), default=_RESULT, help="JSON file to write.")
def main(tiles: int, drops: int, robot: RobotConfig | None, seed: int, out: Path) -> None:
    """Simulate, write JSON and print the table."""
    try:
        import mujoco
    except ImportError:
        raise click.ClickException('MuJoCo is not installed; install it with pip install "torchelev[rl]"') from None
    rng = np.random.default_rng(seed)
    rows: list[Row] = []
    for kind in tqdm([kind for kind in KINDS + UNSEEN_KINDS for _ in range(tiles)], unit="tile"):
        field = make_tiles((kind,), rng)
        rows += rows_of_tile(field, kind, robot or draw_robot(rng), drops, rng)
    config = {"tiles": tiles, "drops": drops, "seed": seed, "robot": vars(robot) if robot else None}
    result = summarize(rows)
    write_json(out, {"config": config | {"friction": _FRICTION, "mujoco": mujoco.__version__}} | result)
    click.echo(table(result))
    click.echo(f"Straight legs clear of the ground in {100 * result['legs_clear']:.0f} % of those labelled standing.")


if __name__ == "__main__":
    main()
