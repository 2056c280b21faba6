"""Train the policy of mjlab's rough velocity task with the map and with the ideal scan, side by side.

    .venv-mjlab/bin/python -m benchmarks.quality.mjlab_training --minutes 30

Two trainings with the task's own settings and seed run at the same time, on one core each, until each has used its
minutes of processor time. Writes benchmarks/results/mjlab_training.json and its plot. After Ctrl-C the same command
continues from the last checkpoints; --restart begins anew. `make train-mjlab` makes the environment and runs this.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks import RESULTS
from benchmarks.quality import mjlab_task
from torchelev.app.results import machine, markdown_table, write_json
from torchelev.viz.style import make_figure, styled, write

SCANS = {"ideal": "ideal scan", "map": "map of the depth camera"}
FOLDER = Path("runs/mjlab_training")
SAVE_EVERY = 10  # iterations


class BudgetSpentError(Exception):
    """The training has used its processor time."""


class Training:
    """One training: its environment, its learner and the curve so far.

    Args:
        scan: what the actor reads, "ideal" or "map".
        seconds: processor time that it may use, those of earlier runs included.
        num_envs: number of robots.
        folder: where the curve and the checkpoint are kept.
    """

    def __init__(self, scan: str, seconds: float, num_envs: int, folder: Path) -> None:
        from mjlab.rl import MjlabOnPolicyRunner
        from mjlab.tasks.velocity.config.go1.rl_cfg import unitree_go1_ppo_runner_cfg

        make = mjlab_task.make_config if scan == "map" else mjlab_task.make_plain_config
        self.env, self.seconds, self.folder, self.scan = mjlab_task.make_env(make(num_envs)), seconds, folder, scan
        self.rewards: list[float] = []
        self.lengths: list[float] = []  # [s] of episodes that ended
        torch.manual_seed(0)
        settings = dataclasses.asdict(unitree_go1_ppo_runner_cfg())
        self.runner = MjlabOnPolicyRunner(self._wrap(), settings, log_dir=None, device="cpu")
        self._update, self.runner.alg.update = self.runner.alg.update, self._update_and_note
        self.curve: list[dict[str, float]] = []
        if self.curve_path.exists():
            self.curve = json.loads(self.curve_path.read_text())
            self.runner.alg.load(torch.load(self.checkpoint, weights_only=False), None, True)
            self.env.common_step_counter = self.curve[-1]["steps"] // num_envs
        self.used = self.curve[-1]["cpu_s"] if self.curve else 0.0
        self.began = time.process_time()

    @property
    def curve_path(self) -> Path:
        """File of the curve."""
        return self.folder / f"{self.scan}.json"

    @property
    def checkpoint(self) -> Path:
        """File of the learner."""
        return self.folder / f"{self.scan}.pt"

    def run(self) -> None:
        """Learn until the processor time is used."""
        try:
            self.runner.learn(10**6)
        except BudgetSpentError:
            print(f"{self.scan}: {len(self.curve)} iterations in {self.curve[-1]['cpu_s'] / 60:.1f} minutes")

    def _wrap(self) -> Any:
        """Return the environment for rsl-rl, noting rewards and the lengths of episodes."""
        from mjlab.rl import RslRlVecEnvWrapper

        training = self

        class Noting(RslRlVecEnvWrapper):
            def step(self, actions: Any) -> Any:
                before = self.unwrapped.episode_length_buf.clone()
                result = super().step(actions)
                ended = before[result[2] > 0] + 1
                training.rewards.append(float(result[1].mean()))
                training.lengths.extend((ended * self.unwrapped.step_dt).tolist())
                return result

        return Noting(self.env)

    def _update_and_note(self) -> dict[str, float]:
        losses = self._update()
        recent = self.lengths[-100:]
        terrain = self.env.scene.terrain.terrain_levels.float().mean()
        self.curve.append(
            {
                "steps": (len(self.curve) + 1) * self.runner.cfg["num_steps_per_env"] * self.env.num_envs,
                "cpu_s": self.used + time.process_time() - self.began,
                "reward_per_s": sum(self.rewards) / len(self.rewards) / self.env.step_dt,
                "episode_s": sum(recent) / len(recent)
                if recent
                else self.env.step_dt * self.runner.cfg["num_steps_per_env"],
                "level": float(terrain),
            }
        )
        self.rewards.clear()
        spent = self.curve[-1]["cpu_s"] >= self.seconds
        if spent or len(self.curve) % SAVE_EVERY == 0:
            torch.save(self.runner.alg.save(), self.checkpoint)
            self.curve_path.write_text(json.dumps(self.curve))
            row = self.curve[-1]
            print(
                f"{self.scan:5} iteration {len(self.curve):4}, {row['cpu_s'] / 60:4.1f} min: reward "
                f"{row['reward_per_s']:6.3f} per s, episodes {row['episode_s']:5.2f} s",
                flush=True,
            )
        if spent:
            raise BudgetSpentError
        return losses


@styled()
def plot(result: dict[str, Any], path: Path) -> Any:
    """Draw reward and length of the episodes over the iterations, both trainings side by side."""
    figure = make_figure(9, 3.4)
    kinds = {"reward_per_s": "reward per second", "episode_s": "length of the last 100 episodes [s]"}
    for place, (name, title) in enumerate(kinds.items()):
        axes = figure.add_subplot(1, 2, place + 1)
        for scan, color in zip(SCANS, ("0.5", "C0"), strict=True):
            values = [row[name] for row in result["curves"][scan]]
            axes.plot(range(1, len(values) + 1), values, color=color, linewidth=1.2, label=SCANS[scan])
        axes.set(xlabel="iteration", title=title)
        if place == 0:
            axes.legend(loc="lower right")
    write(figure, path)
    return figure


def table(result: dict[str, Any], last: int = 20) -> str:
    """Tabulate the ends of both curves, over the last iterations that both have."""
    common = min(len(curve) for curve in result["curves"].values())
    last = min(last, common)
    rows = []
    for scan, name in SCANS.items():
        curve = result["curves"][scan]
        ends = [sum(row[key] for row in curve[common - last : common]) / last for key in ("reward_per_s", "episode_s")]
        rows.append([name, str(len(curve)), *(f"{end:.2f}" for end in ends)])
    head = ["the actor reads", "iterations", "reward per second", "length of an episode [s]"]
    robots, steps = result["num_envs"], result["curves"]["map"][0]["steps"] // result["num_envs"]
    which = f"Means of iterations {common - last + 1} to {common}"
    return f"{markdown_table(head, rows)}\n\n{which}; {robots} robots, {steps} steps an iteration, one seed."


def main(arguments: list[str] | None = None) -> None:
    """Run both trainings, or one of them in this process, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0, help="processor time of each training")
    parser.add_argument("--envs", type=int, default=64, help="number of robots")
    parser.add_argument("--restart", action="store_true", help="begin anew")
    parser.add_argument("--scan", choices=tuple(SCANS), help="run this training alone, in this process")
    args = parser.parse_args(arguments)
    if args.restart:
        shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True, exist_ok=True)
    if args.scan:
        torch.set_num_threads(1)
        Training(args.scan, 60 * args.minutes, args.envs, FOLDER).run()
        return
    command = [sys.executable, "-W", "ignore", "-m", "benchmarks.quality.mjlab_training"]
    options = ["--minutes", str(args.minutes), "--envs", str(args.envs)]
    threads = os.environ | {"OMP_NUM_THREADS": "1"}
    running = [subprocess.Popen([*command, *options, "--scan", scan], env=threads) for scan in SCANS]
    if any([process.wait() for process in running]):
        sys.exit("a training failed; its message is above")
    result = {
        "versions": {name: importlib.metadata.version(name) for name in mjlab_task.PACKAGES},
        "machine": machine(),
        "task": "Mjlab-Velocity-Rough-Unitree-Go1",
        "num_envs": args.envs,
        "minutes": args.minutes,
        "curves": {scan: json.loads((FOLDER / f"{scan}.json").read_text()) for scan in SCANS},
    }
    write_json(RESULTS / "mjlab_training.json", result)
    plot(result, RESULTS / "mjlab_training.svg")
    print(table(result))


if __name__ == "__main__":
    main()
