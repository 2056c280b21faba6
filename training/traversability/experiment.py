"""Do other seeds train heads as good? `python -m training.traversability.experiment`

Trains with three seeds, each on maps of its own, and evaluates all on the same ground beside the analytic heads and the
paper's filter. What is finished is kept: after Ctrl-C, run it again. Writes training/results/traversability.json and
traversability.png.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import click
from tqdm import tqdm

from torchelev.app.results import write_json
from torchelev.robot import RobotConfig
from torchelev.traversability.net import TraversabilityNet
from training.traversability.evaluate import SPLITS, evaluate, table
from training.traversability.maps.mapping import DataConfig
from training.traversability.robot import RobotType

# Fixed before the first run.
SEEDS = (0, 1, 2)
BATCHES, EXACT_BATCHES, STEPS, EVALUATION_BATCHES = 300, 100, 4000, 20
RESULTS = Path(__file__).parents[1] / "results"


def train(seed: int, folder: Path, data: Path, robot: str | None) -> None:
    """Run one training in a process of its own, or finish one that was stopped."""
    command = [sys.executable, "-m", "training.traversability", "--seed", str(seed), "--out", str(folder)]
    command += ["--data", str(data), "--batches", str(BATCHES), "--steps", str(STEPS)]
    command += ["--exact-batches", str(EXACT_BATCHES), "--evaluation-batches", str(EVALUATION_BATCHES)]
    command += ["--robot", robot] if robot else []
    command += ["--resume"] if (folder / "checkpoint.pt").exists() else []
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "log.txt").open("a") as log:
        # Two trainings on a core each are faster than one after the other on both.
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        subprocess.run(command, check=True, env=environment, stdout=log, stderr=subprocess.STDOUT)


def train_all(runs: Path, jobs: int, robot: str | None) -> None:
    """Run the trainings that are not finished."""
    left = [seed for seed in SEEDS if not (runs / f"seed-{seed}" / "result.json").exists()]
    bar = tqdm(total=len(SEEDS), initial=len(SEEDS) - len(left), unit="training")
    with ThreadPoolExecutor(jobs) as pool, bar:
        started = [pool.submit(train, seed, runs / f"seed-{seed}", runs / "data", robot) for seed in left]
        try:
            for done in as_completed(started):
                done.result()
                bar.update()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)  # or it would begin all that are queued
            raise


@click.command()
@click.option("--runs", type=click.Path(path_type=Path), default=Path("runs/traversability_experiment"))
@click.option("--jobs", default=2, show_default=True, help="Trainings at once, each on a core of its own.")
@click.option("--robot", default=None, help="length=0.7,width=0.4,... or a YAML file. Default: any.")
@click.option("--paper-weights", type=click.Path(path_type=Path, exists=True), default=None, help="To compare with.")
def main(runs: Path, jobs: int, robot: str | None, paper_weights: Path | None) -> None:
    """Train with each seed, evaluate, write the results; finished trainings in RUNS are kept."""
    cfg = DataConfig(robot=_robot(robot))
    train_all(runs, jobs, robot)
    nets = {str(seed): TraversabilityNet.from_pretrained(runs / f"seed-{seed}" / "weights.pt") for seed in SEEDS}
    result = evaluate(nets, runs / "data", EVALUATION_BATCHES, cfg, paper_weights)
    fixed = {"seeds": SEEDS, "batches": BATCHES, "exact_batches": EXACT_BATCHES, "steps": STEPS}
    write_json(RESULTS / "traversability.json", result | {"training": fixed})
    shutil.copy(runs / f"seed-{SEEDS[0]}" / "maps.png", RESULTS / "traversability.png")
    for split in SPLITS:
        click.echo(f"\n{split}\n\n{table(result, split)}")


def _robot(text: str | None) -> RobotConfig | None:
    return None if text is None else RobotType().convert(text, None, None)


if __name__ == "__main__":
    main()
