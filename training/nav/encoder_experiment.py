"""Compare encoders of the map at equal steps: a perceptron, a convolutional network and attention.

    python -m training.nav.encoder_experiment

Trains two seeds with each encoder, all with the map in the loop, and deploys every policy on held-out ground. Finished
trainings are kept in RUNS: after Ctrl-C, run the command again. Writes training/results/encoders.json and encoders.png.
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
from training.nav.encoders import ENCODERS
from training.nav.evaluate import evaluate
from training.nav.runs import load_policy, read_curve
from training.nav.success_plot import draw_success
from training.nav.train import task_config
from training.options import jobs_option, runs_option
from training.runs import mean, spread

# Fixed before the first run, as are the encoders' sizes in training/nav/encoders.py.
SEEDS = (0, 1)
ITERATIONS, NUM_ENVS, EPISODES = 60, 256, 512
CASES = [(encoder, seed) for seed in SEEDS for encoder in ENCODERS]
NAMES = {"mlp": "MLP", "cnn": "CNN", "attention": "attention"}


def _folder(runs: Path, encoder: str, seed: int) -> Path:
    return runs / f"{encoder}-{seed}"


def _jobs(runs: Path) -> list[Job]:
    """Return a training for each encoder and seed."""
    fixed = {"--iterations": ITERATIONS, "--num-envs": NUM_ENVS, "--perception": "map"}
    return [
        Job("training.nav", {"--encoder": encoder, "--seed": seed, **fixed}, _folder(runs, encoder, seed))
        for encoder, seed in CASES
    ]


def deploy_all(runs: Path, evaluate: Callable[..., dict[str, Any]] = evaluate) -> dict[str, Any]:
    """Deploy every policy on held-out ground with the map in the loop."""
    rows = []
    for encoder, seed in tqdm(CASES, unit="policy"):
        folder = _folder(runs, encoder, seed)
        trained = json.loads((folder / "result.json").read_text())["training"]
        deployed = evaluate(load_policy(folder), task_config(held_out=True), "map", EPISODES, compiled=True)
        row = {"encoder": encoder, "seed": seed, "training": trained, "deployed": deployed}
        rows.append(row | {"curve": read_curve(folder, NUM_ENVS)})
    fixed = {"seeds": SEEDS, "iterations": ITERATIONS, "num_envs": NUM_ENVS, "episodes": EPISODES}
    return {"config": fixed, "rows": rows}


def table(result: dict[str, Any]) -> str:
    """Tabulate the endings by encoder: the mean over the seeds, and the lowest and highest success."""
    head = ["encoder", "success on held-out ground", "fallen", "stuck", "out of time"]
    lines = []
    for encoder in ENCODERS:
        rows = [row for row in result["rows"] if row["encoder"] == encoder]
        endings = [mean([row["deployed"][name] for row in rows]) for name in ("fallen", "stuck", "truncated")]
        success = spread([row["deployed"]["success"] for row in rows])
        lines.append([NAMES[encoder], success, *(f"{100 * fraction:.0f} %" for fraction in endings)])
    return markdown_table(head, lines)


def plot(result: dict[str, Any], path: Path) -> None:
    """Draw the success during training and when deployed."""
    draw_success(result, "encoder", NAMES, "encoder", path)


@click.command(help=__doc__)
@runs_option("runs/encoder_experiment")
@jobs_option
def main(runs: Path, jobs: int) -> None:
    """Train, deploy, write JSON and figure and print the table."""
    train_all(_jobs(runs), jobs)
    result = deploy_all(runs)
    write_json(RESULTS / "encoders.json", result)
    plot(result, RESULTS / "encoders.png")
    click.echo(table(result))


if __name__ == "__main__":
    main()
