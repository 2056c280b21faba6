"""Where the time of a training step of the quadruped goes, with each perception.

    python -m training.quadruped.step_time

Runs iterations of training with the map in the loop, with the truth and blind, in turn, on all cores. Writes
training/results/quadruped-step-time.json.
"""

from __future__ import annotations

import contextlib
import io
import time
from collections import defaultdict
from collections.abc import Callable
from statistics import median
from typing import Any

import click
import torch
from tqdm import tqdm

from envs.quadruped.config import PERCEPTION
from envs.quadruped.sight import MapSight
from torchelev.app.results import markdown_table, write_json
from training import RESULTS
from training.quadruped.train import make_runner
from training.runner import ResumableRunner

PARTS = ("physics", "rays", "map", "scan", "critic's scan", "policy", "learning")
_WARM_UP = 2  # iterations, of which the first compiles the map's update


class Clock:
    """Adds up the time [s] that parts of a training take.

    Args:
        runner: The training; its parts report to this clock from now on.
    """

    def __init__(self, runner: ResumableRunner) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        task = runner.env.task
        self._watch(task.physics, "step", "physics")
        self._watch(task.sight, "read", "scan")
        self._watch(task.truth, "read", "critic's scan")
        self._watch(runner.alg, "act", "policy")
        self._watch(runner.alg, "update", "learning")
        if isinstance(task.sight, MapSight):
            self._watch(task.sight, "look", "rays")
            self._watch(task.sight.emap, "update", "map")

    def _watch(self, owner: Any, name: str, part: str) -> None:
        function = getattr(owner, name)

        def timed(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.seconds[part] += time.perf_counter() - start

        setattr(owner, name, timed)


def measure(
    num_envs: int, rounds: int, make_runner: Callable[..., ResumableRunner] = make_runner
) -> list[dict[str, Any]]:
    """Return for each perception the median time [ms] of a step of all robots, whole and by part."""
    runners = {name: make_runner(num_envs, name, 0, "cpu", None) for name in PERCEPTION}
    clocks = {name: Clock(runner) for name, runner in runners.items()}
    times: dict[str, list[dict[str, float]]] = {name: [] for name in PERCEPTION}
    for k in tqdm(range(_WARM_UP + rounds), unit="round"):
        for name, runner in runners.items():
            clocks[name].seconds.clear()
            start = time.perf_counter()
            with contextlib.redirect_stderr(io.StringIO()):  # its own progress bar
                runner.learn(1)
            if k >= _WARM_UP:
                times[name].append({**clocks[name].seconds, "whole": time.perf_counter() - start})
    rows = []
    for name, runner in runners.items():
        steps = runner.cfg["num_steps_per_env"]
        parts = {
            part: round(1e3 * median(t.get(part, 0.0) for t in times[name]) / steps, 2) for part in (*PARTS, "whole")
        }
        rows.append({"perception": name, "ms": parts, "steps_per_s": round(1e3 * num_envs / parts["whole"])})
    return rows


def table(result: dict[str, Any]) -> str:
    """Tabulate the time of a step by part, and the steps per second."""
    rows = {row["perception"]: row for row in result["rows"]}
    lines = [[part, *(f"{rows[name]['ms'][part]:.1f}" for name in rows)] for part in PARTS]
    rest = [row["ms"]["whole"] - sum(row["ms"][part] for part in PARTS) for row in rows.values()]
    lines.append(["all else", *(f"{value:.1f}" for value in rest)])
    lines.append(["**whole step** [ms]", *(f"{row['ms']['whole']:.1f}" for row in rows.values())])
    lines.append(
        [
            "**by that with the truth**",
            *(f"{row['ms']['whole'] / rows['truth']['ms']['whole']:.2f}" for row in rows.values()),
        ]
    )
    lines.append(["**environment steps / s**", *(f"{row['steps_per_s']:,}" for row in rows.values())])
    return markdown_table([f"{result['num_envs']} robots", *rows], lines)


@click.command(help=__doc__)
@click.option("--num-envs", default=256, show_default=True, help="Number of robots.")
@click.option("--rounds", default=9, show_default=True, help="Measured iterations with each perception.")
def main(num_envs: int, rounds: int) -> None:
    """Measure, write JSON and print the table."""
    rows = measure(num_envs, rounds)
    result = {"num_envs": num_envs, "rounds": rounds, "threads": torch.get_num_threads(), "rows": rows}
    write_json(RESULTS / "quadruped-step-time.json", result)
    click.echo(table(result))


if __name__ == "__main__":
    main()
