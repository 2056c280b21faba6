"""Compare what a policy sees where its map is unknown: the nominal ground or inpainted ground.

    python -m training.nav.fill_experiment

The image has four channels: elevation, upper bound, validity and traversability. Only the elevation of unknown pixels
differs: "base", the nominal ground below the base, is the usual image of the task; "inpaint" is a rule
of `HeightScan`. Every policy sees the validity, and so knows which pixels are filled. A further case that shows the
validity alone would be "base" again. Networks, other inputs, seeds and budget are the same.

Trains three seeds with each fill, all with the map in the loop, and deploys every policy with its fill on held-out
ground. Finished trainings are kept in RUNS: after Ctrl-C, run the command again. Writes training/results/fill.json and
fill.png.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import torch
from tqdm import tqdm

from envs.terrain_nav import TerrainNav, TerrainNavConfig
from envs.terrain_nav.sight import LAYERS
from torchelev.app.results import markdown_table, write_json
from training import RESULTS
from training.jobs import Job, train_all
from training.nav.evaluate import evaluate, straight_line
from training.nav.runs import load_policy, read_curve
from training.nav.success_plot import draw_success
from training.nav.train import TaskConfig, task_config
from training.options import jobs_option, runs_option
from training.runs import mean, spread

# Fixed before the first run.
FILLS = ("base", "inpaint")
SEEDS = (0, 1, 2)
ITERATIONS, NUM_ENVS, EPISODES = 60, 256, 512
NAMES = {"base": "nominal ground", "inpaint": "inpainted"}
STEPS = 25  # of the walk over which the error of the filled pixels is averaged


def _folder(runs: Path, fill: str, seed: int) -> Path:
    return runs / f"{fill}-{seed}"


def cases(num_seeds: int) -> list[tuple[str, int]]:
    """Return fills and seeds, the first seed of every fill first."""
    return [(fill, seed) for seed in SEEDS[:num_seeds] for fill in FILLS]


def _jobs(runs: Path, num_seeds: int) -> list[Job]:
    """Return a training for each fill and seed."""
    fixed = {"--iterations": ITERATIONS, "--num-envs": NUM_ENVS, "--perception": "map"}
    return [
        Job("training.nav", {"--fill": fill, "--seed": seed, **fixed}, _folder(runs, fill, seed))
        for fill, seed in cases(num_seeds)
    ]


@torch.inference_mode()
def unknown_error(cfg: TerrainNavConfig, num_envs: int = NUM_ENVS) -> float:
    """Return the mean absolute error [m] of unknown pixels' elevation, while robots walk straight to their goals."""
    task = TerrainNav(cfg, num_envs, seed=7)
    total = count = torch.zeros(())
    for _ in range(STEPS):
        seen = task.observe()
        unknown = seen["map"][:, LAYERS.index("validity")] == 0
        error = (seen["map"][:, 0] - seen["truth"][:, 0]).abs()
        total, count = total + error[unknown].sum(), count + unknown.sum()
        task.reset(task.advance(straight_line(seen)).done)
        task.sense()
    return float(total / count)


def deploy_all(
    runs: Path,
    num_seeds: int,
    config: TaskConfig = task_config,
    num_envs: int = NUM_ENVS,
    episodes: int = EPISODES,
    compiled: bool = True,
) -> dict[str, Any]:
    """Deploy every policy with its fill on held-out ground, with the map in the loop."""
    rows = []
    for fill, seed in tqdm(cases(num_seeds), unit="policy"):
        folder = _folder(runs, fill, seed)
        trained = json.loads((folder / "result.json").read_text())["training"]
        cfg = config(held_out=True, fill=fill)
        deployed = evaluate(load_policy(folder), cfg, "map", episodes, compiled=compiled)
        row = {"fill": fill, "seed": seed, "training": trained, "deployed": deployed}
        rows.append(row | {"curve": read_curve(folder, num_envs)})
    fixed = {"seeds": SEEDS[:num_seeds], "iterations": ITERATIONS, "num_envs": num_envs, "episodes": episodes}
    errors = {fill: unknown_error(config(held_out=True, fill=fill), num_envs) for fill in FILLS}
    return {"config": fixed, "unknown_error_m": errors, "rows": rows}


def table(result: dict[str, Any]) -> str:
    """Tabulate the endings by fill: the mean over the seeds, and the lowest and highest success."""
    head = ["unknown pixels show", "their mean error", "seeds", "success on held-out ground", "fallen", "stuck",
            "out of time", "minutes of training"]  # fmt: skip
    lines = []
    for fill in FILLS:
        rows = [row for row in result["rows"] if row["fill"] == fill]
        endings = [mean([row["deployed"][name] for row in rows]) for name in ("fallen", "stuck", "truncated")]
        success = spread([row["deployed"]["success"] for row in rows])
        minutes = mean([row["training"]["seconds"] / 60 for row in rows])
        error = f"{100 * result['unknown_error_m'][fill]:.1f} cm"
        cells = [error, f"{len(rows)}", success, *(f"{100 * fraction:.1f} %" for fraction in endings), f"{minutes:.0f}"]
        lines.append([NAMES[fill], *cells])
    return markdown_table(head, lines)


def plot(result: dict[str, Any], path: Path) -> None:
    """Draw the success during training and when deployed."""
    draw_success(result, "fill", NAMES, "unknown pixels show", path)


@click.command(help=__doc__)
@runs_option("runs/fill_experiment")
@jobs_option
@click.option(
    "--seeds",
    type=click.IntRange(1, len(SEEDS)),
    default=len(SEEDS),
    show_default=True,
    help="Number of trainings with each fill; the table says it.",
)
def main(runs: Path, jobs: int, seeds: int) -> None:
    """Train, deploy, write JSON and figure and print the table."""
    train_all(_jobs(runs, seeds), jobs)
    result = deploy_all(runs, seeds)
    write_json(RESULTS / "fill.json", result)
    plot(result, RESULTS / "fill.png")
    click.echo(table(result))


if __name__ == "__main__":
    main()
