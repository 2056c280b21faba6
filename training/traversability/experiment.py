"""Train the learned head with three seeds and compare them with the analytic heads and the paper's filter.

    python -m training.traversability.experiment

Each seed trains on its own maps; all are evaluated on the same held-out ground. Finished trainings are kept in RUNS:
after Ctrl-C, run the command again. Writes training/results/traversability.json and traversability.png.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import click

from torchelev.app.results import write_json
from torchelev.robot import RobotConfig
from torchelev.traversability.net import TraversabilityNet
from training import RESULTS
from training.jobs import Job, train_all
from training.options import jobs_option, paper_weights_option, runs_option
from training.traversability.evaluate import SPLITS, evaluate, table
from training.traversability.maps.mapping import DataConfig
from training.traversability.robot import RobotType

# Fixed before the first run.
SEEDS = (0, 1, 2)
BATCHES, EXACT_BATCHES, STEPS, EVALUATION_BATCHES = 300, 100, 4000, 20


def _jobs(runs: Path, robot: str | None) -> list[Job]:
    """Return a training for each seed."""
    fixed = {
        "--data": runs / "data",
        "--batches": BATCHES,
        "--exact-batches": EXACT_BATCHES,
        "--steps": STEPS,
        "--evaluation-batches": EVALUATION_BATCHES,
        "--robot": robot,
    }
    return [Job("training.traversability", {"--seed": seed, **fixed}, _folder(runs, seed)) for seed in SEEDS]


def _folder(runs: Path, seed: int) -> Path:
    return runs / f"seed-{seed}"


@click.command(help=__doc__)
@runs_option("runs/traversability_experiment")
@jobs_option
@click.option("--robot", default=None, help="length=0.7,width=0.4,... or a YAML file. Default: any robot.")
@paper_weights_option
def main(runs: Path, jobs: int, robot: str | None, paper_weights: Path | None) -> None:
    """Train, evaluate, write JSON and figure and print the tables."""
    cfg = DataConfig(robot=_robot(robot))
    train_all(_jobs(runs, robot), jobs)
    nets = {str(seed): TraversabilityNet.from_pretrained(_folder(runs, seed) / "weights.pt") for seed in SEEDS}
    result = evaluate(nets, runs / "data", EVALUATION_BATCHES, cfg, paper_weights)
    fixed = {"seeds": SEEDS, "batches": BATCHES, "exact_batches": EXACT_BATCHES, "steps": STEPS}
    write_json(RESULTS / "traversability.json", result | {"training": fixed})
    shutil.copy(_folder(runs, SEEDS[0]) / "maps.png", RESULTS / "traversability.png")
    for split in SPLITS:
        click.echo(f"\n{split}\n\n{table(result, split)}")


def _robot(text: str | None) -> RobotConfig | None:
    return None if text is None else RobotType().convert(text, None, None)


if __name__ == "__main__":
    main()
