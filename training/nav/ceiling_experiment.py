"""Compare policies that see ceilings with some that do not, on a course of walls with gates, tables and beams.

    python -m training.nav.ceiling_experiment

Half of what hangs is too low to pass under, and a body that meets it falls (`CoversConfig`). Every policy sees the four
layers of the map's image. "none" has a map without levels and nothing more; "scan" adds a height scan of the ceiling
and its mask, "drop" the same scan as heights below 1 m, so that it reads 0 where nothing hangs, and "voxels" what a
`VoxelCrop` finds occupied; all three have a map with levels. "truth" reads the true ground, with white noise, and the
true ceiling: no map can show more. Cameras, networks and all other settings are the same, and so are the critics, which
see the truth.

Budget and seeds were fixed before the first run: 36 iterations of 256 robots and 24 steps, at most about 6 minutes for
a training beside other work; two seeds; 512 episodes on held-out tiles for each policy. Course and cameras were chosen
on the training ground with another seed. "drop" was added when the results of the others were known. Finished trainings
are kept in RUNS: after Ctrl-C, run the command again. Writes training/results/ceilings.json and ceilings.png.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from torchelev.app.results import markdown_table, write_json
from training import RESULTS
from training.jobs import Job, train_all
from training.nav.evaluate import evaluate, straight_line
from training.nav.runs import load_policy, read_curve
from training.nav.success_plot import draw_success
from training.nav.train import task_config
from training.options import jobs_option, runs_option
from training.runs import mean, spread

# Fixed before the first run.
SEEDS = (0, 1)
ITERATIONS, NUM_ENVS, EPISODES = 36, 256, 512
NAMES = {
    "none": "no ceilings",
    "scan": "ceiling scan",
    "drop": "ceiling scan, 0 where nothing hangs",
    "voxels": "voxels",
    "truth": "the truth",
}
CASES = [(sees, seed) for seed in SEEDS for sees in NAMES]
ENDINGS = ("success", "bumped", "fallen", "stuck", "truncated")


def options_of(sees: str) -> tuple[str, str]:
    """Return the perception, and the ceilings of `SightConfig`, by what a policy sees."""
    return ("truth", "scan") if sees == "truth" else ("map", sees)


def _folder(runs: Path, sees: str, seed: int) -> Path:
    return runs / f"{sees}-{seed}"


def _jobs(runs: Path) -> list[Job]:
    """Return a training for each case."""
    fixed = {"--iterations": ITERATIONS, "--num-envs": NUM_ENVS, "--course": "covered"}
    jobs = []
    for sees, seed in CASES:
        perception, ceilings = options_of(sees)
        own = {"--perception": perception, "--ceilings": ceilings, "--seed": seed}
        jobs.append(Job("training.nav", own | fixed, _folder(runs, sees, seed)))
    return jobs


def deploy_all(runs: Path, evaluate: Callable[..., dict[str, Any]] = evaluate) -> dict[str, Any]:
    """Deploy every policy on held-out tiles, with what it was trained to see."""
    rows = []
    for sees, seed in tqdm(CASES, unit="policy"):
        folder, (perception, ceilings) = _folder(runs, sees, seed), options_of(sees)
        trained = json.loads((folder / "result.json").read_text())["training"]
        cfg = task_config(held_out=True, course="covered", ceilings=ceilings)
        deployed = evaluate(load_policy(folder), cfg, perception, EPISODES, compiled=True)
        row = {"sees": sees, "seed": seed, "training": trained, "deployed": deployed}
        rows.append(row | {"curve": read_curve(folder, NUM_ENVS)})
    fixed = {"seeds": SEEDS, "iterations": ITERATIONS, "num_envs": NUM_ENVS, "episodes": EPISODES}
    line = evaluate(straight_line, task_config(held_out=True, course="covered"), "blind", EPISODES)
    return {"config": fixed, "straight_line": line, "rows": rows}


def table(result: dict[str, Any]) -> str:
    """Tabulate the endings by what policies see: the mean over the seeds, and the lowest and highest."""
    head = ["the policy sees", "success on held-out tiles", "hit a box", "stuck", "out of time", "minutes of training"]
    lines = []
    for sees, name in NAMES.items():
        rows = [row for row in result["rows"] if row["sees"] == sees]
        ends = {ending: [row["deployed"][ending] for row in rows] for ending in ENDINGS}
        minutes = mean([row["training"]["seconds"] / 60 for row in rows])
        late = [f"{100 * mean(ends[ending]):.0f} %" for ending in ("stuck", "truncated")]
        lines.append([name, spread(ends["success"]), spread(ends["bumped"]), *late, f"{minutes:.1f}"])
    line = result["straight_line"]
    cells = [f"{100 * line[ending]:.0f} %" for ending in ("success", "bumped", "stuck", "truncated")]
    return markdown_table(head, [*lines, ["(a straight line)", *cells, ""]])


def plot(result: dict[str, Any], path: Path) -> None:
    """Draw the success during training and when deployed."""
    short = {"none": "none", "scan": "scan", "drop": "drop", "voxels": "voxels", "truth": "truth"}
    draw_success(result, "sees", short, "ceilings that the policy sees", path)


@click.command(help=__doc__)
@runs_option("runs/ceiling_experiment")
@jobs_option
def main(runs: Path, jobs: int) -> None:
    """Train, deploy, write JSON and figure and print the table."""
    train_all(_jobs(runs), jobs)
    result = deploy_all(runs)
    write_json(RESULTS / "ceilings.json", result)
    plot(result, RESULTS / "ceilings.png")
    click.echo(table(result))


if __name__ == "__main__":
    main()
