"""TerrainNav for gymnasium: a single environment with arrays, and a vector environment with tensors."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from envs.task_env import TaskEnv, TaskVectorEnv
from envs.terrain_nav.config import TerrainNavConfig
from envs.terrain_nav.task import TerrainNav


def _draw(task: TerrainNav, index: int) -> np.ndarray:
    from envs.terrain_nav.render import draw

    return draw(task, index)


class TerrainNavEnv(TaskEnv):
    """One robot, with NumPy actions and observations: `gymnasium.make("torchelev/TerrainNav-v0", perception="map")`.

    Args:
        render_mode: "rgb_array" makes `render` return pictures of ground, map, robot and goal.
        cfg: The settings of the task; None for the defaults.
        perception: "map", "truth" or "blind", see `TerrainNav`.
        device: Where the task is computed.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 5}

    def __init__(
        self,
        render_mode: str | None = None,
        cfg: TerrainNavConfig | None = None,
        perception: str = "map",
        device: str = "cpu",
    ) -> None:
        super().__init__(TerrainNav(cfg, 1, device, perception), render_mode, _draw)


class TerrainNavVectorEnv(TaskVectorEnv):
    """Many robots, with tensor actions and observations: `gymnasium.make_vec("torchelev/TerrainNav-v0", num_envs=N)`.

    Args:
        num_envs: Number of robots.
        max_episode_steps: Steps after which an episode is truncated, if that is earlier than in `cfg`.
        render_mode: "rgb_array" makes `render` return pictures.
        cfg: The settings of the task; None for the defaults.
        perception: "map", "truth" or "blind", see `TerrainNav`.
        device: Where the task is computed.
        compiled: Build what the map's updates run on at once; else the first one does.
        autoreset_mode: NEXT_STEP or SAME_STEP, see `TaskVectorEnv`.
        critic: Add "truth" to the observations.
        task: A task that is already seeded. It replaces `num_envs`, `cfg`, `perception`, `device` and `compiled`.
        final_obs: Whether SAME_STEP returns `info["final_obs"]`; False avoids reading the maps twice in each step.

    Raises:
        ValueError: The autoreset mode is neither of the two.
    """

    metadata: dict[str, Any] = {
        "render_modes": ["rgb_array"],
        "render_fps": 5,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
        "torch": True,
    }

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        cfg: TerrainNavConfig | None = None,
        perception: str = "map",
        device: str = "cpu",
        compiled: bool = False,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        critic: bool = False,
        task: TerrainNav | None = None,
        final_obs: bool = True,
    ) -> None:
        own = TerrainNav(cfg, num_envs, device, perception, compiled=compiled) if task is None else task
        is_seeded = task is not None
        super().__init__(own, max_episode_steps, render_mode, _draw, autoreset_mode, critic, final_obs, is_seeded)
