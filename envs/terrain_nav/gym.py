"""TerrainNav for gymnasium: a single environment with arrays, and a vector environment with tensors."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor

from envs.terrain_nav.config import TerrainNavConfig
from envs.terrain_nav.task import NUM_ACTIONS, TerrainNav
from torchelev.errors import require

_MAX_SEED = 2**31


def _make_spaces(task: TerrainNav, critic: bool = False) -> tuple[gymnasium.Space[Any], gymnasium.Space[Any]]:
    """Return the spaces of a single robot's observations and actions."""
    boxes: dict[str, gymnasium.Space[Any]] = {
        name: spaces.Box(-np.inf, np.inf, value.shape[1:], np.float32) for name, value in task.observe(critic).items()
    }
    return spaces.Dict(boxes), spaces.Box(-1.0, 1.0, (NUM_ACTIONS,), np.float32)


def _draw_seed(generator: np.random.Generator) -> int:
    return int(generator.integers(_MAX_SEED))


class TerrainNavEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """One robot, with NumPy actions and observations: `gymnasium.make("torchelev/TerrainNav-v0", perception="map")`.

    Args:
        render_mode: "rgb_array" makes `render` return pictures.
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
        self.render_mode = render_mode
        self.task = TerrainNav(cfg, 1, device, perception)
        self.observation_space, self.action_space = _make_spaces(self.task)
        self._is_seeded = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        if seed is not None or not self._is_seeded:
            self.task.seed(_draw_seed(self.np_random))
            self._is_seeded = True
        self.task.reset()
        self.task.sense()
        return self._observe(), self._info()

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Move the robot, sense and observe."""
        outcome = self.task.advance(torch.as_tensor(np.asarray(action), device=self.task.device)[None])
        self.task.sense()
        info = self._info() | {name: bool(getattr(outcome, name)) for name in ("success", "fallen", "stuck")}
        return self._observe(), float(outcome.reward), bool(outcome.terminated), bool(outcome.truncated), info

    def _observe(self) -> dict[str, np.ndarray]:
        return {name: value[0].cpu().numpy() for name, value in self.task.observe(critic=False).items()}

    def _info(self) -> dict[str, Any]:
        return {"distance": float(self.task.distance)}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Return a picture (h, w, 3) of ground, map, robot and goal, if `render_mode` is "rgb_array"."""
        from envs.terrain_nav.render import draw

        return draw(self.task) if self.render_mode == "rgb_array" else None


class TerrainNavVectorEnv(VectorEnv[dict[str, Tensor], Tensor, Tensor]):
    """Many robots, with tensor actions and observations: `gymnasium.make_vec("torchelev/TerrainNav-v0", num_envs=N)`.

    Args:
        num_envs: Number of robots.
        max_episode_steps: Steps after which an episode is truncated, if that is earlier than in `cfg`.
        render_mode: "rgb_array" makes `render` return pictures.
        cfg: The settings of the task; None for the defaults.
        perception: "map", "truth" or "blind", see `TerrainNav`.
        device: Where the task is computed.
        compiled: Run the map's update compiled.
        autoreset_mode: When an episode has ended, NEXT_STEP begins the next one in the following step, which ignores
            its action. SAME_STEP begins it in the same step; `info["final_obs"]` are then the last observations of the
            episode, with the map before the last measurement.
        critic: Add "truth" to the observations.
        task: A task that is already seeded. It replaces `num_envs`, `cfg`, `perception`, `device` and `compiled`.
        final_obs: Whether SAME_STEP returns `info["final_obs"]`; False avoids reading the maps twice in each step.

    Raises:
        ValueError: The autoreset mode is none of the two.
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
        modes = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)
        is_known = autoreset_mode in modes
        require(is_known, "autoreset_mode", "must be NEXT_STEP or SAME_STEP", autoreset_mode, "choose one of them")
        self.task = TerrainNav(cfg, num_envs, device, perception, compiled=compiled) if task is None else task
        self.num_envs, self.render_mode, self.max_episode_steps = self.task.num_envs, render_mode, max_episode_steps
        self.metadata, self.critic = {**self.metadata, "autoreset_mode": autoreset_mode}, critic
        self.final_obs = final_obs
        self.single_observation_space, self.single_action_space = _make_spaces(self.task, critic)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, self.num_envs)
        self._ended = torch.zeros(self.num_envs, dtype=torch.bool, device=self.task.device)
        self._is_seeded = task is not None

    @property
    def max_episode_length(self) -> int:
        """Number of steps after which an episode is truncated."""
        own = self.task.cfg.max_episode_length
        return own if self.max_episode_steps is None else min(own, self.max_episode_steps)

    @property
    def episode_length_buf(self) -> Tensor:
        """Number of steps of the current episodes (B,); can be set."""
        return self.task.episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        self.task.episode_length.copy_(value)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Begin new episodes in all environments, or in those of `options["reset_mask"]` (B,)."""
        super().reset(seed=seed)
        if seed is not None or not self._is_seeded:
            self.task.seed(_draw_seed(self.np_random))
            self._is_seeded = True
        mask = (options or {}).get("reset_mask")
        mask = None if mask is None else torch.as_tensor(mask, dtype=torch.bool, device=self.task.device)
        self.task.reset(mask)
        self._ended = self._ended & ~mask if mask is not None else torch.zeros_like(self._ended)
        self.task.sense(mask)
        return self._observe(), {"distance": self.task.distance}

    def step(self, actions: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, dict[str, Any]]:
        """Move the robots, or begin the next episode where one has ended; then sense and observe."""
        starts, task = self._ended, self.task
        outcome = task.advance(torch.as_tensor(actions, device=task.device))
        truncated = outcome.truncated
        if self.max_episode_steps is not None:
            truncated = truncated | (task.episode_length >= self.max_episode_steps) & ~outcome.terminated
        terminated, truncated = outcome.terminated & ~starts, truncated & ~starts
        info: dict[str, Any] = {name: getattr(outcome, name) & ~starts for name in ("success", "fallen", "stuck")}
        ended = terminated | truncated
        if self.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP:
            info |= {"final_obs": self._observe(), "_final_obs": ended} if self.final_obs else {}
            task.reset(ended)
        else:
            task.reset(starts)
            self._ended = ended
        task.sense()
        info |= {
            "distance": task.distance,
            "log": {f"/{name}": fraction for name, fraction in task.ending_fractions.items()},
        }
        return self._observe(), torch.where(starts, 0.0, outcome.reward), terminated, truncated, info

    def _observe(self) -> dict[str, Tensor]:
        return self.task.observe(self.critic)

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """Return pictures of the first four environments, if there is a `render_mode`."""
        from envs.terrain_nav.render import draw

        return tuple(draw(self.task, k) for k in range(min(4, self.num_envs))) if self.render_mode else None
