"""TerrainNav for gymnasium: one environment of arrays, and many of tensors."""

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

MOST_SEED = 2**31


def _spaces(task: TerrainNav, critic: bool = False) -> tuple[spaces.Dict, spaces.Box]:
    shapes = {name: value.shape[1:] for name, value in task.observe(critic).items()}
    seen = {name: spaces.Box(-np.inf, np.inf, shape, np.float32) for name, shape in shapes.items()}
    return spaces.Dict(seen), spaces.Box(-1.0, 1.0, (NUM_ACTIONS,), np.float32)


def _seed(env: TerrainNavEnv | TerrainNavVectorEnv, seed: int | None) -> None:
    """Seed the task from gymnasium's generator: when a seed is given, and the first time."""
    if seed is not None or not env._seeded:
        env.task.seed(int(env.np_random.integers(MOST_SEED)))
        env._seeded = True


class TerrainNavEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """One robot, NumPy in and out: `gymnasium.make("torchelev/TerrainNav-v0", perception="map")`."""

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
        self.observation_space, self.action_space = _spaces(self.task)
        self._seeded = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        _seed(self, seed)
        self.task.reset()
        self.task.sense()
        return self._observe(), self._info()

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Move, look and return what is seen."""
        outcome = self.task.advance(torch.as_tensor(np.asarray(action), device=self.task.device)[None])
        self.task.sense()
        info = self._info() | {name: bool(getattr(outcome, name)) for name in ("success", "fallen", "stuck")}
        return self._observe(), float(outcome.reward), bool(outcome.terminated), bool(outcome.truncated), info

    def _observe(self) -> dict[str, np.ndarray]:
        return {name: value[0].cpu().numpy() for name, value in self.task.observe(critic=False).items()}

    def _info(self) -> dict[str, Any]:
        return {"distance": float(self.task.distance)}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Return a picture (h, w, 3) of truth and map with the robot and its goal, if `render_mode` is "rgb_array"."""
        from envs.terrain_nav.render import draw

        return draw(self.task) if self.render_mode == "rgb_array" else None


class TerrainNavVectorEnv(VectorEnv[dict[str, Tensor], Tensor, Tensor]):
    """Many robots, tensors in and out: `gymnasium.make_vec("torchelev/TerrainNav-v0", num_envs=N)`.

    An environment whose episode ended begins the next one in the following step, whose action it ignores
    (`AutoresetMode.NEXT_STEP`). In SAME_STEP it begins in the step that ends the last one; `final_obs` of `info` is
    then where the robots ended, by the maps of one look before. With `critic` observations have "truth". A `task` takes
    the place of `num_envs`, `cfg`, `perception`, `device` and `compiled`, and is seeded already. `final_obs=False`
    saves reading the maps twice in each step.
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
        self.single_observation_space, self.single_action_space = _spaces(self.task, critic)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, self.num_envs)
        self._ended = torch.zeros(self.num_envs, dtype=torch.bool, device=self.task.device)
        self._seeded = task is not None

    @property
    def max_episode_length(self) -> int:
        """Steps after which an episode is truncated."""
        own = self.task.cfg.max_episode_length
        return own if self.max_episode_steps is None else min(own, self.max_episode_steps)

    @property
    def episode_length_buf(self) -> Tensor:
        """Steps of the running episodes (B,); can be set."""
        return self.task.episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        self.task.episode_length.copy_(value)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Begin episodes everywhere, or where `options["reset_mask"]` (B,) is true."""
        super().reset(seed=seed)
        _seed(self, seed)
        mask = (options or {}).get("reset_mask")
        mask = None if mask is None else torch.as_tensor(mask, dtype=torch.bool, device=self.task.device)
        self.task.reset(mask)
        self._ended = self._ended & ~mask if mask is not None else torch.zeros_like(self._ended)
        self.task.sense(mask)
        return self._observe(), {"distance": self.task.distance}

    def step(self, actions: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, dict[str, Any]]:
        """Move, or begin the next episode where the last one ended, and look."""
        began, task = self._ended, self.task
        outcome = task.advance(torch.as_tensor(actions, device=task.device))
        truncated = outcome.truncated
        if self.max_episode_steps is not None:
            truncated = truncated | (task.episode_length >= self.max_episode_steps) & ~outcome.terminated
        terminated, truncated = outcome.terminated & ~began, truncated & ~began
        info: dict[str, Any] = {name: getattr(outcome, name) & ~began for name in ("success", "fallen", "stuck")}
        ended = terminated | truncated
        if self.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP:
            info |= {"final_obs": self._observe(), "_final_obs": ended} if self.final_obs else {}
            task.reset(ended)
        else:
            task.reset(began)
            self._ended = ended
        task.sense()
        info |= {"distance": task.distance, "log": {f"/{name}": share for name, share in task.shares.items()}}
        return self._observe(), torch.where(began, 0.0, outcome.reward), terminated, truncated, info

    def _observe(self) -> dict[str, Tensor]:
        return self.task.observe(self.critic)

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """Return a picture of each of the first four environments."""
        from envs.terrain_nav.render import draw

        return tuple(draw(self.task, k) for k in range(min(4, self.num_envs))) if self.render_mode else None
