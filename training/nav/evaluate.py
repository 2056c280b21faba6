"""Deploy a policy on ground it has not seen: one episode in each environment."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.terrain_nav import TerrainNav, TerrainNavConfig
from envs.terrain_nav.task import ENDINGS

Policy = Callable[[Any], Tensor]


def straight_line(observation: Any) -> Tensor:
    """Turn to the goal and walk: what a robot without eyes would do."""
    cos, sin = observation["policy"][:, 3], observation["policy"][:, 4]
    return torch.stack([(cos > 0.5).float(), 2 * torch.atan2(sin, cos)], -1).clamp(-1, 1)


def observed(task: TerrainNav) -> TensorDict:
    """Return what a policy of rsl-rl takes."""
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
    """Run that many first episodes; return the share of each ending and the mean time to success [s], if any did."""
    task = TerrainNav(cfg, episodes, device, perception, seed, compiled)
    endings = torch.zeros(len(ENDINGS), episodes, dtype=torch.bool, device=device)
    seconds = torch.zeros(episodes, device=device)
    for step in range(cfg.max_episode_length):
        outcome = task.advance(policy(observed(task)))
        going = ~endings.any(0)
        endings |= torch.stack([getattr(outcome, name) for name in ENDINGS]) & going
        seconds = torch.where(outcome.success & going, (step + 1) * cfg.dt, seconds)
        if bool(endings.any(0).all()):
            break
        task.reset(outcome.done)
        task.sense()
    shares = {name: float(share.float().mean()) for name, share in zip(ENDINGS, endings, strict=True)}
    reached = int(endings[0].sum())
    return shares | {"seconds": float(seconds.sum()) / reached if reached else None, "episodes": episodes}


@torch.inference_mode()
def picture(policy: Policy, cfg: TerrainNavConfig, path: Path, device: str = "cpu", frames: int = 5) -> None:
    """Draw one episode as a strip of pictures."""
    from envs.terrain_nav.render import save_strip, snapshot

    task = TerrainNav(cfg, 1, device, "map", seed=11)
    shots = [snapshot(task)]
    for _ in range(cfg.max_episode_length):
        outcome = task.advance(policy(observed(task)))
        task.sense()
        shots.append(snapshot(task))
        if bool(outcome.done):
            break
    chosen = [shots[round(k * (len(shots) - 1) / (frames - 1))] for k in range(frames)]
    save_strip(chosen, path, trail=[shot.xy for shot in shots], cfg=cfg)
