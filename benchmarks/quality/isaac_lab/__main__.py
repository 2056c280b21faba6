"""Run Isaac Lab's rough velocity task with a map in place of its ideal height scan, compare the two, and time both.

    .venv-isaaclab/bin/python -m benchmarks.quality.isaac_lab

4 robots take 200 steps of random actions, and begin anew where they fall; where the maps are known, their height scans
are compared with Isaac Lab's own, which sees through everything. Writes benchmarks/results/isaac_lab.json.
`make bench-isaaclab` makes the environment and runs this.
"""

from __future__ import annotations

import importlib.metadata
import statistics
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks import RESULTS
from benchmarks.quality.isaac_lab import task
from benchmarks.quality.isaac_lab.report import SENSORS, table
from benchmarks.quality.mjlab_task import compare
from torchelev.app.results import write_json

PACKAGES = ("isaaclab", "newton", "mujoco-warp", "warp-lang", "torch", "rsl-rl-lib")


def time_steps(env: Any, rounds: int = 150) -> dict[str, float]:
    """Return the time of a control step [ms] with each observation: medians of steps that alternate.

    Of one without a scan, and of what the next ones take longer, which other programs on the machine disturb less.
    """
    cfg = task.find_term(env, "policy", "height_scan")
    observe = {"neither": _read_nothing, "ideal scan": _read_ideal, "camera": _read_camera, "map": cfg.func}
    times: dict[str, list[float]] = {name: [] for name in observe}
    actions = torch.zeros(env.num_envs, env.action_manager.total_action_dim)
    for _ in range(rounds):
        for name, cfg.func in observe.items():
            start = time.perf_counter()
            env.step(actions)
            times[name].append(1e3 * (time.perf_counter() - start))
    base = statistics.median(times["neither"])
    more = {name: [a - b for a, b in zip(values, times["neither"], strict=True)] for name, values in times.items()}
    return {name: base + statistics.median(values) for name, values in more.items()}


def _read_nothing(env: Any, **params: Any) -> torch.Tensor:
    return torch.zeros(env.num_envs, 187)


def _read_ideal(env: Any, **params: Any) -> torch.Tensor:
    return task.mdp.height_scan(env, task.SceneEntityCfg("height_scanner"))


def _read_camera(env: Any, **params: Any) -> torch.Tensor:
    _ = env.scene["camera"].data  # sensors measure when they are read
    return _read_nothing(env)


def main(path: Path = RESULTS / "isaac_lab.json", steps: int = 200) -> None:
    """Run, print and write the results."""
    env = task.make_env(task.AllSensorsCfg())
    walked = task.walk(env, task.find_terms(env), steps)
    num_envs = env.num_envs
    env.close()
    env = task.make_env(task.MapEnvCfg())
    results = {
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
        "num_envs": num_envs,
        "steps": steps,
        "milliseconds_per_step": time_steps(env),
        "error": {name: compare(walked[name]) for name in SENSORS},
    }
    env.close()
    write_json(path, results)
    print(table(results))


if __name__ == "__main__":
    main()
