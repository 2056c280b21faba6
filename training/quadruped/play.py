"""Watch a policy: walk over one kind of terrain and write a video or a strip of pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from tqdm import tqdm

from envs.quadruped import Quadruped, QuadrupedConfig
from envs.quadruped.render import draw, save_strip, save_video
from torchelev.errors import require
from training.quadruped.policy import Policy, sight_of

_EVERY = 2  # steps between two pictures: 25 a second


@torch.inference_mode()
def play(
    policy: Policy,
    cfg: QuadrupedConfig,
    path: Path,
    kind: str = "stairs up",
    level: int = 3,
    seconds: float = 8.0,
    seed: int = 0,
    perception: str = "map",
    draw: Callable[[Quadruped], Any] = draw,
    save: Callable[[list[Any], Path], None] | None = None,
) -> None:
    """Walk and draw it, with the map over the ground if the policy sees it.

    Args:
        policy: Maps an observation to actions.
        cfg: The task.
        path: Where to write: .webp is a moving picture, .png a strip of five.
        kind: Kind of terrain by what the robot meets, one of `cfg.terrain.labels`.
        level: Difficulty, from 0.
        seconds: Duration.
        seed: Of start, body and noise.
        perception: With which the policy was trained. A blind one walks blind, others with the map.
        draw: Makes a picture.
        save: Writes the pictures; None: by the suffix of the path.

    Raises:
        ValueError: There is no such kind or level.
        RuntimeError: MuJoCo finds no OpenGL.
    """
    kinds = cfg.terrain.labels
    require(kind in kinds, "kind", f"must be one of {', '.join(kinds)}", kind, "choose one of them")
    fits = 0 <= level < cfg.terrain.num_levels
    require(fits, "level", f"must be from 0 to {cfg.terrain.num_levels - 1}", level, "choose one of them")
    task = Quadruped(cfg, 1, perception=sight_of(perception), seed=seed)
    task.kind.fill_(kinds.index(kind))
    task.place_at(torch.full((1,), level))
    pictures = [draw(task)]
    for step in tqdm(range(round(seconds / cfg.dt)), unit="step"):
        outcome = task.advance(policy(TensorDict(task.observe(critic=False), batch_size=[1])))
        if step % _EVERY == 0:
            pictures.append(draw(task))
        if bool(outcome.done):
            break
        task.sense()
    (save or (save_video if path.suffix == ".webp" else save_strip))(pictures, path)
