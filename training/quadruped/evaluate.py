"""Evaluate a walking policy: one episode in each environment, by kind of terrain and difficulty."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.quadruped import Quadruped, QuadrupedConfig
from envs.quadruped.episode.outcome import ENDINGS
from torchelev.app.results import markdown_table

Policy = Callable[[Any], Tensor]


def stand_in_trot(observation: Any) -> Tensor:
    """Return actions of 0: the trot as it is, without learning."""
    return torch.zeros(len(observation["policy"]), Quadruped.num_actions)


@torch.inference_mode()
def evaluate(
    policy: Policy,
    cfg: QuadrupedConfig,
    perception: str = "map",
    episodes: int = 280,
    device: str = "cpu",
    compiled: bool = False,
    seed: int = 7,
) -> dict[str, Any]:
    """Run one episode in each of `episodes` environments.

    Levels and kinds are spread evenly. A success is a tile that the robot has crossed.

    Args:
        policy: Maps an observation to actions (B, 12).
        cfg: The task; its terrain should be one that the training does not use.
        perception: What the policy sees, as in `Quadruped`.
        episodes: Number of environments.
        device: Where the task runs, but for the physics.
        compiled: Build updates ahead.
        seed: Of starts, bodies, commands and noise.

    Returns:
        "all", "by_kind" and "by_level": the fraction of episodes by ending, and the mean forward speed by the one that
        was commanded, None where none was; and `episodes`. Kinds are called by what the robot meets.
    """
    task = Quadruped(cfg, episodes, device, perception, seed, compiled)
    task.place_at(even_levels(task))
    level, kind = task.level.clone(), task.kind.clone()
    endings = torch.zeros(len(ENDINGS), episodes, dtype=torch.bool, device=task.device)
    walked, asked = torch.zeros(2, episodes, device=task.device)
    for _ in range(cfg.max_episode_length):
        command = task.command[:, 0].clone()
        outcome = task.advance(policy(TensorDict(task.observe(critic=False), batch_size=[episodes])))
        going = ~endings.any(0)
        walked += task.forward_speed * going
        asked += command * going
        endings |= torch.stack([getattr(outcome, name) for name in ENDINGS]) & going
        if bool(endings.any(0).all()):
            break
        task.reset(outcome.done)
        task.sense()
    kinds = {name: kind == k for k, name in enumerate(cfg.terrain.labels)}
    by_level = {
        name: {str(k): _summarize(endings, walked, asked, chosen & (level == k)) for k in range(cfg.terrain.num_levels)}
        for name, chosen in kinds.items()
    }
    by_kind = {name: _summarize(endings, walked, asked, chosen) for name, chosen in kinds.items()}
    everything = _summarize(endings, walked, asked, torch.ones_like(kind, dtype=torch.bool))
    return {"all": everything, "by_kind": by_kind, "by_level": by_level, "episodes": episodes}


def even_levels(task: Quadruped) -> Tensor:
    """Return levels (B,) such that kinds and levels are spread evenly."""
    terrain = task.cfg.terrain
    return (torch.arange(task.num_envs, device=task.device) // len(terrain.kinds)) % terrain.num_levels


def _summarize(endings: Tensor, walked: Tensor, asked: Tensor, chosen: Tensor) -> dict[str, float | None]:
    """Return the fractions of the chosen episodes by ending, and the walked distance by the commanded speed."""
    count = int(chosen.sum())
    shares = {
        name: round(float((ended & chosen).sum()) / max(1, count), 4)
        for name, ended in zip(ENDINGS, endings, strict=True)
    }
    total_walked, total_asked = (float((value * chosen).sum()) for value in (walked, asked))
    speed = round(total_walked / total_asked, 4) if total_asked else None
    return {**shares, "speed": speed, "episodes": count}


def table(result: dict[str, Any]) -> str:
    """Tabulate an evaluation by kind of terrain."""
    head = ["terrain", "crossed", "fallen", "timed out", "speed by command"]
    rows = [
        [name, *(f"{100 * row[key]:.0f} %" for key in ENDINGS), _speed(row["speed"])]
        for name, row in (result["by_kind"] | {"all": result["all"]}).items()
    ]
    return markdown_table(head, rows)


def _speed(speed: float | None) -> str:
    """Return the speed by the commanded one, or a dash where none was commanded."""
    return "–" if speed is None else f"{speed:.2f}"
