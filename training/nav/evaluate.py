"""Evaluate a policy: one episode in each environment, and a figure of an episode."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.terrain_nav import TerrainNav, TerrainNavConfig
from envs.terrain_nav.outcome import ENDINGS

Policy = Callable[[Any], Tensor]


def straight_line(observation: Any) -> Tensor:
    """Turn to the goal and walk straight, without perception."""
    cos, sin = observation["policy"][:, 3], observation["policy"][:, 4]
    return torch.stack([(cos > 0.5).float(), 2 * torch.atan2(sin, cos)], -1).clamp(-1, 1)


def _observe(task: TerrainNav) -> TensorDict:
    """Return the observation as rsl-rl's policies take it."""
    return TensorDict(task.observe(), batch_size=[task.num_envs])


@torch.inference_mode()
def evaluate(
    policy: Policy,
    cfg: TerrainNavConfig,
    perception: str = "map",
    episodes: int = 256,
    device: str = "cpu",
    compiled: bool = False,
    seed: int = 7,
) -> dict[str, float | None]:
    """Run one episode in each of `episodes` environments.

    Args:
        policy: maps an observation to actions (B, 2).
        cfg: the task; its course should be one that the training does not use.
        perception: what the policy sees, as in `TerrainNav`.
        episodes: number of environments.
        device: where the task runs.
        compiled: compile the map's update.
        seed: of starts, goals and noise.

    Returns:
        The fraction of episodes by ending, the mean time to success [s], None without a success, and `episodes`; on a
        course with covers also the fraction `bumped`, of falls because the body met a box.
    """
    task = TerrainNav(cfg, episodes, device, perception, seed, compiled)
    endings = torch.zeros(len(ENDINGS), episodes, dtype=torch.bool, device=device)
    seconds = torch.zeros(episodes, device=device)
    bumped = torch.zeros(episodes, dtype=torch.bool, device=device)
    for step in range(cfg.max_episode_length):
        outcome = task.advance(policy(_observe(task)))
        going = ~endings.any(0)
        bumped |= outcome.bumped & going
        endings |= torch.stack([getattr(outcome, name) for name in ENDINGS]) & going
        seconds = torch.where(outcome.success & going, (step + 1) * cfg.dt, seconds)
        if bool(endings.any(0).all()):
            break
        task.reset(outcome.done)
        task.sense()
    fractions = {name: float(ended.float().mean()) for name, ended in zip(ENDINGS, endings, strict=True)}
    if cfg.course.covers is not None:
        fractions["bumped"] = float(bumped.float().mean())
    reached = int(endings[0].sum())
    return fractions | {"seconds": float(seconds.sum()) / reached if reached else None, "episodes": episodes}


@torch.inference_mode()
def picture(policy: Policy, cfg: TerrainNavConfig, path: Path, device: str = "cpu", frames: int = 5) -> None:
    """Draw one episode as a strip of `frames` pictures and write it to `path`."""
    from envs.terrain_nav.render import save_strip, snapshot

    task = TerrainNav(cfg, 1, device, "map", seed=11)
    shots = [snapshot(task)]
    for _ in range(cfg.max_episode_length):
        outcome = task.advance(policy(_observe(task)))
        task.sense()
        shots.append(snapshot(task))
        if bool(outcome.done):
            break
    chosen = [shots[round(k * (len(shots) - 1) / (frames - 1))] for k in range(frames)]
    save_strip(chosen, path, trail=[shot.xy for shot in shots], cfg=cfg)
