"""What experiments read from the folders of finished trainings, and how they write figures of several seeds."""

from __future__ import annotations

from pathlib import Path

import torch

from training.nav.evaluate import Policy
from training.nav.train import ppo_config


def load_policy(folder: Path) -> Policy:
    """Return the exported policy of a training."""
    scripted = torch.jit.load(str(folder / "policy.pt"))
    return lambda observation: scripted(observation["policy"], [observation["map"]])


def read_curve(folder: Path, num_envs: int) -> dict[str, list[float]]:
    """Read the success during training over environment steps from the TensorBoard log."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = EventAccumulator(str(folder))
    log.Reload()
    values = {
        point.step: round(point.value, 4) for point in log.Scalars("/success")
    }  # a resumed training repeats steps
    steps = ppo_config()["num_steps_per_env"] * num_envs
    return {"steps": [(step + 1) * steps for step in sorted(values)], "success": [values[k] for k in sorted(values)]}


def mean(values: list[float]) -> float:
    """Return the mean."""
    return sum(values) / len(values)


def spread(values: list[float]) -> str:
    """Return fractions as percentages: the mean, and the lowest and highest."""
    return f"{100 * mean(values):.1f} % ({100 * min(values):.1f} to {100 * max(values):.1f})"
