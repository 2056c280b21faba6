"""Tasks made of tensors as gymnasium environments: one robot with arrays, or many with tensors.

A task offers `advance`, `reset`, `sense` and `observe` as separate calls; these environments call them in the order of
gymnasium's interfaces.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor

from torchelev.errors import require

_MAX_SEED = 2**31
_MAX_PICTURES = 4  # of the environments that `render` draws


class Outcome(Protocol):
    """Result of a step for B robots."""

    @property
    def reward(self) -> Tensor:
        """Reward (B,)."""

    @property
    def terminated(self) -> Tensor:
        """Whether the robot's actions have ended the episode (B,) bool."""

    @property
    def truncated(self) -> Tensor:
        """Whether the episode was cut (B,) bool."""


class Task(Protocol):
    """B robots whose state is tensors."""

    num_envs: int
    num_actions: int
    max_action: float
    episode_length: Tensor

    @property
    def device(self) -> torch.device:
        """Where the tensors are stored."""

    @property
    def max_episode_length(self) -> int:
        """Number of steps after which an episode is truncated."""

    @property
    def log(self) -> dict[str, Tensor]:
        """Figures that a training shows."""

    def seed(self, seed: int) -> None:
        """Seed all random number generators."""

    def reset(self, mask: Tensor | None = None) -> None:
        """Begin new episodes in the environments of `mask` (B,) bool, or in all."""

    def advance(self, action: Tensor) -> Any:
        """Move the robots by one step; return an `Outcome`."""

    def sense(self, mask: Tensor | None = None) -> None:
        """Let the robots sense the ground."""

    def observe(self, critic: bool = True) -> dict[str, Tensor]:
        """Return new tensors with the current observations."""

    def info(self, outcome: Any | None) -> dict[str, Tensor]:
        """Return further values (B,) of the current state, and of the step that led to it."""


def make_spaces(task: Task, critic: bool = False) -> tuple[gymnasium.Space[Any], gymnasium.Space[Any]]:
    """Return the spaces of a single robot's observations and actions."""
    boxes: dict[str, gymnasium.Space[Any]] = {
        name: spaces.Box(-np.inf, np.inf, value.shape[1:], np.float32) for name, value in task.observe(critic).items()
    }
    return spaces.Dict(boxes), spaces.Box(-task.max_action, task.max_action, (task.num_actions,), np.float32)


class TaskEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """One robot, with NumPy actions and observations.

    Args:
        task: A task of one robot.
        render_mode: "rgb_array" makes `render` return pictures.
        draw: Returns a picture (h, w, 3) of an environment of a task.
    """

    def __init__(self, task: Task, render_mode: str | None, draw: Callable[[Any, int], np.ndarray]) -> None:
        self.task, self.render_mode, self._draw = task, render_mode, draw
        self.observation_space, self.action_space = make_spaces(task)
        self._is_seeded = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        if seed is not None or not self._is_seeded:
            self.task.seed(int(self.np_random.integers(_MAX_SEED)))
            self._is_seeded = True
        self.task.reset()
        self.task.sense()
        return self._observe(), self._info(None)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Move the robot, sense and observe."""
        outcome = self.task.advance(torch.as_tensor(np.asarray(action), device=self.task.device)[None])
        self.task.sense()
        ends = bool(outcome.terminated), bool(outcome.truncated)
        return self._observe(), float(outcome.reward), *ends, self._info(outcome)

    def _observe(self) -> dict[str, np.ndarray]:
        return {name: value[0].cpu().numpy() for name, value in self.task.observe(critic=False).items()}

    def _info(self, outcome: Any | None) -> dict[str, Any]:
        return {name: value[0].item() for name, value in self.task.info(outcome).items()}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Return a picture (h, w, 3), if `render_mode` is "rgb_array"."""
        return self._draw(self.task, 0) if self.render_mode == "rgb_array" else None


class TaskVectorEnv(VectorEnv[dict[str, Tensor], Tensor, Tensor]):
    """Many robots, with tensor actions and observations.

    Args:
        task: A task of B robots.
        max_episode_steps: Steps after which an episode is truncated, if that is earlier than the task's.
        render_mode: "rgb_array" makes `render` return pictures.
        draw: Returns a picture (h, w, 3) of an environment of a task.
        autoreset_mode: When an episode has ended, NEXT_STEP begins the next one in the following step, which ignores
            its action. SAME_STEP begins it in the same step; `info["final_obs"]` are then the last observations of the
            episode, with the map before the last measurement.
        critic: Add to the observations what only a critic may see.
        final_obs: Whether SAME_STEP returns `info["final_obs"]`; False avoids reading the maps twice in each step.
        is_seeded: Whether the task is seeded, and the first reset need not do it.

    Raises:
        ValueError: The autoreset mode is neither of the two.
    """

    def __init__(
        self,
        task: Task,
        max_episode_steps: int | None,
        render_mode: str | None,
        draw: Callable[[Any, int], np.ndarray],
        autoreset_mode: AutoresetMode,
        critic: bool,
        final_obs: bool,
        is_seeded: bool,
    ) -> None:
        modes = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)
        is_known = autoreset_mode in modes
        require(is_known, "autoreset_mode", "must be NEXT_STEP or SAME_STEP", autoreset_mode, "choose one of them")
        self.task, self._draw = task, draw
        self.num_envs, self.render_mode, self.max_episode_steps = task.num_envs, render_mode, max_episode_steps
        self.metadata, self.critic = {**self.metadata, "autoreset_mode": autoreset_mode}, critic
        self.final_obs = final_obs
        self.single_observation_space, self.single_action_space = make_spaces(task, critic)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, self.num_envs)
        self._ended = torch.zeros(self.num_envs, dtype=torch.bool, device=task.device)
        self._is_seeded = is_seeded

    @property
    def max_episode_length(self) -> int:
        """Number of steps after which an episode is truncated."""
        own = self.task.max_episode_length
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
            self.task.seed(int(self.np_random.integers(_MAX_SEED)))
            self._is_seeded = True
        mask = (options or {}).get("reset_mask")
        mask = None if mask is None else torch.as_tensor(mask, dtype=torch.bool, device=self.task.device)
        self.task.reset(mask)
        self._ended = self._ended & ~mask if mask is not None else torch.zeros_like(self._ended)
        self.task.sense(mask)
        return self._observe(), dict(self.task.info(None))

    def step(self, actions: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, dict[str, Any]]:
        """Move the robots, or begin the next episode where one has ended; then sense and observe."""
        starts, task = self._ended, self.task
        outcome = task.advance(torch.as_tensor(actions, device=task.device))
        truncated = outcome.truncated
        if self.max_episode_steps is not None:
            truncated = truncated | (task.episode_length >= self.max_episode_steps) & ~outcome.terminated
        terminated, truncated = outcome.terminated & ~starts, truncated & ~starts
        ended, final = terminated | truncated, {}
        if self.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP:
            final = {"final_obs": self._observe(), "_final_obs": ended} if self.final_obs else {}
            task.reset(ended)
        else:
            task.reset(starts)
            self._ended = ended
        task.sense()
        info: dict[str, Any] = {
            name: value & ~starts if value.dtype is torch.bool else value for name, value in task.info(outcome).items()
        }
        log = {f"/{name}": value for name, value in task.log.items()}
        reward = torch.where(starts, 0.0, outcome.reward)
        return self._observe(), reward, terminated, truncated, info | final | {"log": log}

    def _observe(self) -> dict[str, Tensor]:
        return self.task.observe(self.critic)

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """Return pictures of the first four environments, if there is a `render_mode`."""
        count = min(_MAX_PICTURES, self.num_envs)
        return tuple(self._draw(self.task, k) for k in range(count)) if self.render_mode else None
