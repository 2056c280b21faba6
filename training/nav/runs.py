"""Results that experiments read from the folders of finished trainings."""

from __future__ import annotations

from pathlib import Path

import torch

from training.nav.evaluate import Policy
from training.nav.train import ppo_config
from training.runs import read_scalars


def load_policy(folder: Path) -> Policy:
    """Return the exported policy of a training."""
    scripted = torch.jit.load(str(folder / "policy.pt"))
    return lambda observation: scripted(observation["policy"], [observation["map"]])


def read_curve(folder: Path, num_envs: int) -> dict[str, list[float]]:
    """Return the success during training over environment steps."""
    values = read_scalars(folder, "/success")
    steps = ppo_config()["num_steps_per_env"] * num_envs
    return {"steps": [(step + 1) * steps for step in values], "success": [round(v, 4) for v in values.values()]}
