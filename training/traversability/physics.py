"""Do the labels tell where a robot stands? `python -m training.traversability.physics` asks MuJoCo.

On terrain as trained on, and on the kind never trained on, stances are drawn at random, up to as many that the labels
let stand as not. A rigid box on four balls is put down there and simulated: on the label's footholds where it says that
the robot stands, else with its feet under the body's corners, each stretched towards the ground (`drop`). It stood if
after 1.5 s it has moved by less than 7 % of its length and tilted by less than 0.1 rad, and nothing but feet touched
the ground. Each is dropped twice: with a usual friction of 0.9, and with hardly more than max_slope needs.

What this sees: footholds that do not hold, stances that tip or slide, bodies that touch. What it does not: whether a
leg can lift its foot over the step between two feet; whether a body can keep gentler than the plane through its feet,
which stiff legs of any length do; whether another choice of footholds would have stood where the label says that none
does; and controllers, which make more or less of a stance than stiff legs. Legs touch nothing; how many straight ones
would cut the ground is counted. So it can show that a label is rash; where it stood against the label, the label may be
cautious or right.
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
from training.traversability.labels.drop import drop, legs_clear, on_footholds, on_nominal_places
from training.traversability.labels.stances import STANDS, VERDICTS, ground_around, stances
from training.traversability.maps.terrain import KINDS, LENGTH, RIM, UNSEEN_KINDS, draw_robot, make_tiles
from training.traversability.robot import RobotType

RESULT = Path(__file__).parents[1] / "results" / "traversability-physics.json"
CANDIDATES = 400  # stances on a tile to draw from
HEADINGS = 8
FRICTION = 0.9  # as is usual between rubber and stone

Row = dict[str, Any]


def rows_of_tile(field: HeightField, kind: str, robot: RobotConfig, count: int, rng: np.random.Generator) -> list[Row]:
    """Draw up to `count` stances on the first tile, half of each label, and drop the robot in each."""
    half = LENGTH / 2 - RIM
    xy = torch.from_numpy(rng.uniform(-half, half, (CANDIDATES, 2))).float()
    theta = torch.from_numpy(rng.integers(HEADINGS, size=CANDIDATES) * (math.pi / HEADINGS)).float()
    found = stances(ground_around(field, 0, xy, robot), xy, theta, robot)
    says = (found.verdict == STANDS).numpy()
    chosen = np.concatenate([np.flatnonzero(says == label)[: count // 2] for label in (True, False)])
    rows = []
    for n in chosen.tolist():
        place = (xy[n], float(theta[n]), robot)
        posture = on_footholds(field, 0, found.feet[n], *place) if says[n] else on_nominal_places(field, 0, *place)
        usual, limit = (drop(field, 0, posture, robot, friction) for friction in (FRICTION, least_friction(robot)))
        rows.append({
            "kind": kind, "verdict": VERDICTS[int(found.verdict[n])], "stood": usual.stood(robot),
            "stood_at_limit": limit.stood(robot), "legs_clear": legs_clear(field, 0, posture, robot),
        })  # fmt: skip
    return rows


def least_friction(robot: RobotConfig) -> float:
    """Return the friction that max_slope needs, and 5 % more: stances at the limit creep without."""
    return 1.05 * math.tan(robot.max_slope)


def summary(rows: list[Row]) -> dict[str, float]:
    """Count how often label and simulation agree."""
    yes, no = ([row for row in rows if (row["verdict"] == "stands") == label] for label in (True, False))
    counts: dict[str, float] = {"standing": len(yes), "not_standing": len(no)}
    for suffix in ("", "_at_limit"):
        stood, fell = sum(row["stood" + suffix] for row in yes), sum(not row["stood" + suffix] for row in no)
        agreement = (stood + fell) / max(1, len(rows))
        counts |= {"stood" + suffix: stood, "fell" + suffix: fell, "agreement" + suffix: agreement}
    return counts


def table(result: dict[str, Any]) -> str:
    """Tabulate by kind of terrain, and what became of stances that labels refuse, by what stops them."""
    head = ["", "labelled standing", "stood", "at the limit", "labelled not", "fell", "at the limit", "agreement",
            "at the limit"]  # fmt: skip
    names = ("standing", "stood", "stood_at_limit", "not_standing", "fell", "fell_at_limit")
    stopped = {f"stopped by {v}": s for v, s in result["by_verdict"].items() if v != "stands"}
    lines = []
    for name, s in (result["by_kind"] | stopped | {"all": result["all"]}).items():
        shares = (f"{100 * s[key]:.1f} %" for key in ("agreement", "agreement_at_limit"))
        lines.append([name, *(str(s[key]) for key in names), *shares])
    return markdown_table(head, lines)


def summarize(rows: list[Row]) -> dict[str, Any]:
    """Return the result: all, by kind of terrain and by verdict."""
    by = {
        name: {value: summary([r for r in rows if r[name] == value]) for value in dict.fromkeys(r[name] for r in rows)}
        for name in ("kind", "verdict")
    }
    standing = [row for row in rows if row["verdict"] == "stands"]
    legs = sum(row["legs_clear"] for row in standing) / max(1, len(standing))
    return {"all": summary(rows), "legs_clear": legs, "by_kind": by["kind"], "by_verdict": by["verdict"]}


@click.command()
@click.option("--tiles", type=click.IntRange(1), default=10, show_default=True, help="Of each kind of terrain.")
@click.option("--drops", type=click.IntRange(2), default=8, show_default=True, help="At most, on each tile.")
@click.option("--robot", type=RobotType(), help="Such as length=0.5,width=0.3. Default: each tile draws its own.")
@click.option("--seed", default=0, show_default=True)
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), default=RESULT, show_default="training/results")
def main(tiles: int, drops: int, robot: RobotConfig | None, seed: int, out: Path) -> None:
    """Drop robots in MuJoCo where labels say that they stand and where not, and report how often both agree."""
    try:
        import mujoco
    except ImportError:
        raise click.ClickException('there is no MuJoCo; install it with pip install "torchelev[rl]"') from None
    rng = np.random.default_rng(seed)
    rows: list[Row] = []
    for kind in tqdm([kind for kind in KINDS + UNSEEN_KINDS for _ in range(tiles)], unit="tile"):
        field = make_tiles((kind,), rng)
        rows += rows_of_tile(field, kind, robot or draw_robot(rng), drops, rng)
    config = {"tiles": tiles, "drops": drops, "seed": seed, "robot": vars(robot) if robot else None}
    result = summarize(rows)
    write_json(out, {"config": config | {"friction": FRICTION, "mujoco": mujoco.__version__}} | result)
    click.echo(table(result))
    click.echo(f"Straight legs clear of the ground in {100 * result['legs_clear']:.0f} % of those labelled standing.")


if __name__ == "__main__":
    main()
