"""Let a trained policy walk while its scans fill unknown ground by other rules than in its training.

    python -m training.quadruped.fills

The policy was trained with scans that read the upper bound over unknown cells. Here the same policy crosses held-out
ground with the map in the loop, once with each rule, from the same starts and with the same noise.
Writes training/results/quadruped_fills.json and prints the table.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import click
import torch
from tqdm import tqdm

from envs.quadruped import Quadruped, QuadrupedConfig
from envs.quadruped.sight import MapSight
from torchelev.app.results import markdown_table, write_json
from training import RESULTS
from training.quadruped.evaluate import evaluate, even_levels, stand_in_trot
from training.quadruped.policy import load_policy
from training.quadruped.train import task_config
from training.runs import mean, spread

# Fixed before the first run.
FILLS = ("upper_bound", "base", "inpaint")
SEEDS, EPISODES = (7, 8, 9), 112  # of starts, bodies and noise; two for each kind, level and seed
STEPS = 100  # of the walk over which the error of the filled points is averaged


def with_fill(cfg: QuadrupedConfig, fill: str) -> QuadrupedConfig:
    """Return the task with scans of another rule."""
    return dataclasses.replace(cfg, sight=dataclasses.replace(cfg.sight, fill=fill))


@torch.inference_mode()
def unknown_error(cfg: QuadrupedConfig, num_envs: int = EPISODES, steps: int = STEPS) -> float:
    """Return the mean absolute error [m] of the scan around the base where it is filled, while robots trot ahead.

    Heights are relative to the base; the drift of the pose within the map counts with them.
    """
    task = Quadruped(cfg, num_envs, perception="map", seed=SEEDS[0])
    assert isinstance(task.sight, MapSight)
    task.place_at(even_levels(task))
    total = count = torch.zeros(())
    for _ in range(steps):
        task.reset(task.advance(stand_in_trot(task.observe(critic=False))).done)
        task.sense()
        view = task.view()
        heights, valid = task.sight.scan(task.sight.emap, view.T_estimated)
        error = (heights - task.truth.read(view)["height_scan"]).abs()
        total, count = total + error[~valid].sum(), count + (~valid).sum()
    return float(total / count)


def measure(
    seeds: tuple[int, ...],
    episodes: int,
    evaluate: Callable[..., dict[str, Any]] = evaluate,
    unknown_error: Callable[[QuadrupedConfig, int], float] = unknown_error,
) -> dict[str, Any]:
    """Deploy the policy with each fill and seed."""
    cfg = task_config(held_out=True)
    policy = load_policy(RESULTS / "quadruped_policy.pt", cfg)
    rows = []
    for fill in tqdm(FILLS, unit="fill"):
        filled = with_fill(cfg, fill)
        runs = [evaluate(policy, filled, "map", episodes, compiled=True, seed=seed) for seed in seeds]
        rows.append({"fill": fill, "unknown_error_m": unknown_error(filled, episodes), "deployed": runs})
    return {"config": {"seeds": seeds, "episodes": episodes}, "rows": rows}


def table(result: dict[str, Any]) -> str:
    """Tabulate the crossed tiles by fill: the mean over the seeds, and the lowest and highest."""
    kinds = list(result["rows"][0]["deployed"][0]["by_kind"])
    head = ["unknown points show", "their mean error", "crossed", *kinds, "fallen"]
    lines = []
    for row in result["rows"]:
        runs = row["deployed"]
        by_kind = [mean([run["by_kind"][kind]["crossed"] for run in runs]) for kind in kinds]
        fallen = mean([run["all"]["fallen"] for run in runs])
        cells = [f"{100 * row['unknown_error_m']:.1f} cm", spread([run["all"]["crossed"] for run in runs])]
        lines.append([f"`{row['fill']}`", *cells, *(f"{100 * share:.0f} %" for share in (*by_kind, fallen))])
    return markdown_table(head, lines)


@click.command(help=__doc__)
def main() -> None:
    """Deploy, write JSON and print the table."""
    result = measure(SEEDS, EPISODES)
    write_json(RESULTS / "quadruped_fills.json", result)
    click.echo(table(result))


if __name__ == "__main__":
    main()
