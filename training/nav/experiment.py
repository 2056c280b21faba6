"""Does a policy need the map in the loop while it learns? `python -m training.nav.experiment`

Trains with each perception and seed, deploys every policy with the map in the loop on held-out ground, and writes
training/results/nav.json and nav.png. What is finished is kept: after Ctrl-C, run it again.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import click
import torch
from tqdm import tqdm

from envs.terrain_nav.config import PERCEPTION
from torchelev.app.results import markdown_table, write_json
from training.nav.evaluate import Policy, evaluate, straight_line
from training.nav.train import ppo_config, task_config

# Fixed before the first run.
SEEDS = (0, 1, 2)
ITERATIONS, NUM_ENVS, EPISODES = 140, 256, 512
RESULTS = Path(__file__).parents[1] / "results"
NAMES = {"map": "map in the loop", "truth": "truth with white noise", "blind": "blind"}


def train(perception: str, seed: int, folder: Path) -> None:
    """Run one training in a process of its own, or finish one that was stopped."""
    command = [sys.executable, "-m", "training.nav.train", "--perception", perception, "--seed", str(seed)]
    command += ["--iterations", str(ITERATIONS), "--num-envs", str(NUM_ENVS), "--out", str(folder)]
    command += ["--resume"] if (folder / "checkpoint.pt").exists() else []
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "log.txt").open("a") as log:
        # Two trainings on a core each are faster than one after the other on both.
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        subprocess.run(command, check=True, env=environment, stdout=log, stderr=subprocess.STDOUT)


def load_policy(folder: Path) -> Policy:
    """Load an exported policy."""
    scripted = torch.jit.load(str(folder / "policy.pt"))
    return lambda observation: scripted(observation["policy"], [observation["map"]])


def curve(folder: Path) -> dict[str, list[float]]:
    """Read environment steps and success while training from the TensorBoard log."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = EventAccumulator(str(folder))
    log.Reload()
    values = {point.step: round(point.value, 4) for point in log.Scalars("/success")}  # a resume repeats some
    each = ppo_config()["num_steps_per_env"] * NUM_ENVS
    return {"steps": [(step + 1) * each for step in sorted(values)], "success": [values[k] for k in sorted(values)]}


def train_all(folder: Path, jobs: int) -> None:
    """Run the trainings that are not finished."""
    cases = [(perception, seed) for perception in PERCEPTION for seed in SEEDS]
    left = [case for case in cases if not (case_folder(folder, *case) / "result.json").exists()]
    bar = tqdm(total=len(cases), initial=len(cases) - len(left), unit="training")
    with ThreadPoolExecutor(jobs) as pool, bar:
        try:
            for done in as_completed([pool.submit(train, *case, case_folder(folder, *case)) for case in left]):
                done.result()
                bar.update()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)  # or it would begin all that are queued
            raise


def case_folder(folder: Path, perception: str, seed: int) -> Path:
    """Return where a training is."""
    return folder / f"{perception}-{seed}"


def deploy_all(folder: Path) -> dict[str, Any]:
    """Deploy every policy; return the result."""
    cfg, rows = task_config(held_out=True), []
    for perception, seed in tqdm([(p, s) for p in PERCEPTION for s in SEEDS], unit="policy"):
        at = case_folder(folder, perception, seed)
        trained = json.loads((at / "result.json").read_text())["training"]
        policy = load_policy(at)
        deployed = evaluate(policy, cfg, "map", EPISODES, compiled=True)
        own = evaluate(policy, cfg, perception, EPISODES, compiled=True)["success"]
        row = {"perception": perception, "seed": seed, "training": trained, "deployed": deployed, "own": own}
        rows.append(row | {"curve": curve(at)})
    fixed = {"seeds": SEEDS, "iterations": ITERATIONS, "num_envs": NUM_ENVS, "episodes": EPISODES}
    line = evaluate(straight_line, cfg, "map", EPISODES, compiled=True)
    return {"config": fixed, "straight_line": line, "rows": rows}


def table(result: dict[str, Any]) -> str:
    """Tabulate success by what the policy was trained with: mean over the seeds, and the lowest and highest."""
    head = ["trained with", "success with the map in the loop", "fallen", "stuck", "out of time",
            "success as trained", "steps / s", "minutes"]  # fmt: skip
    lines = []
    for perception in PERCEPTION:
        rows = [row for row in result["rows"] if row["perception"] == perception]
        ends = {name: [row["deployed"][name] for row in rows] for name in ("success", "fallen", "stuck", "truncated")}
        cells = [_spread(ends["success"]), *(f"{100 * _mean(ends[name]):.0f} %" for name in list(ends)[1:])]
        rate = _mean([row["training"]["steps"] / row["training"]["seconds"] for row in rows])
        minutes = _mean([row["training"]["seconds"] / 60 for row in rows])
        own = _spread([row["own"] for row in rows])
        lines.append([NAMES[perception], *cells, own, f"{rate:,.0f}", f"{minutes:.1f}"])
    line = result["straight_line"]
    shares = [f"{100 * line[name]:.0f} %" for name in ("success", "fallen", "stuck", "truncated")]
    return markdown_table(head, [*lines, ["(a straight line)", *shares, "", "", ""]])


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)


def _spread(values: list[float]) -> str:
    return f"{100 * _mean(values):.1f} % ({100 * min(values):.1f} to {100 * max(values):.1f})"


def plot(result: dict[str, Any], path: Path) -> None:
    """Draw success while training, and deployed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.6), layout="compressed", dpi=90)
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    colors = dict(zip(PERCEPTION, ("tab:green", "tab:blue", "tab:gray"), strict=True))
    for row in result["rows"]:
        first = row["seed"] == SEEDS[0]
        name, color = row["perception"], colors[row["perception"]]
        left.plot(*row["curve"].values(), color=color, linewidth=1, label=NAMES[name] if first else None)
        right.plot(PERCEPTION.index(name), row["deployed"]["success"], "o", color=color)
    left.set(xlabel="environment steps", ylabel="success while training, as trained", ylim=(0, 1))
    left.legend(loc="lower right", fontsize=8)
    right.axhline(result["straight_line"]["success"], color="black", linestyle=":", linewidth=1)
    right.text(-0.3, result["straight_line"]["success"] + 0.02, "straight line", fontsize=8)
    right.set(ylabel="success, map in the loop, held-out ground", ylim=(0, 1), xlim=(-0.4, 2.4))
    right.set_xticks(range(3), [NAMES[name].replace(" with ", "\nwith ") for name in PERCEPTION], fontsize=8)
    figure.savefig(path)


@click.command()
@click.option("--runs", type=click.Path(path_type=Path), default=Path("runs/nav_experiment"), show_default=True)
@click.option("--jobs", default=2, show_default=True, help="Trainings at once, each on a core of its own.")
def main(runs: Path, jobs: int) -> None:
    """Train, deploy, write training/results/nav.json and nav.png; finished trainings in RUNS are kept."""
    train_all(runs, jobs)
    result = deploy_all(runs)
    write_json(RESULTS / "nav.json", result)
    plot(result, RESULTS / "nav.png")
    click.echo(table(result))


if __name__ == "__main__":
    main()
