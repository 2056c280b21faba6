"""Compare policies that were trained with the map in the loop, with the true ground and blind.

    python -m training.nav.experiment

Trains three seeds with each perception and deploys every policy with the map in the loop on held-out ground. Finished
trainings are kept in RUNS: after Ctrl-C, run the command again. Writes training/results/nav.json and nav.png.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
from tqdm import tqdm

from envs.terrain_nav.config import PERCEPTION
from torchelev.app.results import markdown_table, write_json
from torchelev.viz.style import make_figure, styled, write
from training import RESULTS
from training.jobs import Job, train_all
from training.nav.evaluate import evaluate, straight_line
from training.nav.runs import load_policy, read_curve
from training.nav.train import task_config
from training.options import jobs_option, runs_option
from training.runs import mean, spread

# Fixed before the first run.
SEEDS = (0, 1, 2)
ITERATIONS, NUM_ENVS, EPISODES = 140, 256, 512
CASES = [(perception, seed) for perception in PERCEPTION for seed in SEEDS]
NAMES = {"map": "map in the loop", "truth": "truth with white noise", "blind": "blind"}


def _jobs(runs: Path) -> list[Job]:
    """Return a training for each perception and seed."""
    fixed = {"--iterations": ITERATIONS, "--num-envs": NUM_ENVS}
    return [
        Job("training.nav", {"--perception": perception, "--seed": seed, **fixed}, _folder(runs, perception, seed))
        for perception, seed in CASES
    ]


def _folder(runs: Path, perception: str, seed: int) -> Path:
    return runs / f"{perception}-{seed}"


def _deploy_all(runs: Path) -> dict[str, Any]:
    """Deploy every policy on held-out ground."""
    cfg, rows = task_config(held_out=True), []
    for perception, seed in tqdm(CASES, unit="policy"):
        folder = _folder(runs, perception, seed)
        trained = json.loads((folder / "result.json").read_text())["training"]
        policy = load_policy(folder)
        deployed = evaluate(policy, cfg, "map", EPISODES, compiled=True)
        own = evaluate(policy, cfg, perception, EPISODES, compiled=True)["success"]
        row = {"perception": perception, "seed": seed, "training": trained, "deployed": deployed, "own": own}
        rows.append(row | {"curve": read_curve(folder, NUM_ENVS)})
    fixed = {"seeds": SEEDS, "iterations": ITERATIONS, "num_envs": NUM_ENVS, "episodes": EPISODES}
    line = evaluate(straight_line, cfg, "map", EPISODES, compiled=True)
    return {"config": fixed, "straight_line": line, "rows": rows}


def table(result: dict[str, Any]) -> str:
    """Tabulate the success by training perception: the mean over the seeds, and the lowest and highest."""
    head = ["trained with", "success, deployed", "fallen", "stuck", "out of time", "success, as trained"]
    head += ["steps / s", "minutes"]
    lines = []
    for perception in PERCEPTION:
        rows = [row for row in result["rows"] if row["perception"] == perception]
        ends = {name: [row["deployed"][name] for row in rows] for name in ("success", "fallen", "stuck", "truncated")}
        cells = [spread(ends["success"]), *(f"{100 * mean(ends[name]):.0f} %" for name in list(ends)[1:])]
        rate = mean([row["training"]["steps"] / row["training"]["seconds"] for row in rows])
        minutes = mean([row["training"]["seconds"] / 60 for row in rows])
        own = spread([row["own"] for row in rows])
        lines.append([NAMES[perception], *cells, own, f"{rate:,.0f}", f"{minutes:.1f}"])
    line = result["straight_line"]
    percentages = [f"{100 * line[name]:.0f} %" for name in ("success", "fallen", "stuck", "truncated")]
    return markdown_table(head, [*lines, ["(a straight line)", *percentages, "", "", ""]])


@styled()
def plot(result: dict[str, Any], path: Path) -> None:
    """Draw the success during training and when deployed."""
    figure = make_figure(8, 4.2)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.5, 1))
    colors = dict(zip(PERCEPTION, ("C0", "C1", "0.5"), strict=True))
    for row in result["rows"]:
        first = row["seed"] == SEEDS[0]
        name, color = row["perception"], colors[row["perception"]]
        left.plot(*row["curve"].values(), color=color, linewidth=1.2, label=NAMES[name] if first else None)
        right.plot(PERCEPTION.index(name), row["deployed"]["success"], "o", color=color)
    left.set(xlabel="environment steps", ylabel="success", title="while training, as trained", ylim=(0, 1))
    left.legend(loc="lower right")
    left.xaxis.set_major_formatter(lambda steps, _: f"{steps / 1e3:,.0f}k")
    right.axhline(result["straight_line"]["success"], color="black", linestyle=":", linewidth=1)
    right.text(-0.3, result["straight_line"]["success"] - 0.06, "a straight line")
    right.set(title="on the robot's map, held-out ground", ylim=(0, 1), xlim=(-0.4, 2.4), xlabel="trained with")
    right.set_xticks(range(3), ["map", "truth", "nothing"])
    write(figure, path)


@click.command(help=__doc__)
@runs_option("runs/nav_experiment")
@jobs_option
def main(runs: Path, jobs: int) -> None:
    """Train, deploy, write JSON and figure and print the table."""
    train_all(_jobs(runs), jobs)
    result = _deploy_all(runs)
    write_json(RESULTS / "nav.json", result)
    plot(result, RESULTS / "nav.png")
    click.echo(table(result))


if __name__ == "__main__":
    main()
