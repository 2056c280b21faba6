"""Any vector environment of gymnasium as rsl-rl steps it: a `VecEnv` with TensorDict observations.

With a map for an environment that has none, and rsl-rl's runner:

    env = VectorElevationMapObservation(env, points=..., T_map_sensor=..., T_map_base=..., dt=0.02)
    env = GymVecEnv(env, max_episode_length=1000)
    OnPolicyRunner(env, train_cfg, device=env.device).learn(500)
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor

from torchelev.errors import require

try:
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict
except ImportError as error:
    raise ImportError("torchelev.gym.rsl_rl: needs rsl-rl-lib; install it with pip install 'torchelev[rl]'") from error


class GymVecEnv(VecEnv):
    """Step a gymnasium `VectorEnv`, of tensors or arrays, with rsl-rl's `OnPolicyRunner` (rsl-rl-lib 5.4 and 5.5).

    Each entry of a Dict observation is an observation group (B, ...) in float32; any other observation is the group
    "policy". What is returned shares no memory with the environment, as PPO keeps observations across steps.
    `extras` holds "time_outs" (B,), the episodes that were truncated and not terminated, and `infos["log"]` if the
    environment gives one. Actions are passed on as the policy draws them, without bounds.

    If the unwrapped environment has a tensor `episode_length_buf` (B,), this is read and set; else the steps are
    counted here, and cannot be set: learn with `init_at_random_ep_len=False`.

    A subclass whose environment changes between steps, such as by a checkpoint, overrides `get_observations`.

    Args:
        env: a vector environment in `AutoresetMode.SAME_STEP`, with a Box (A,) of actions: tensors if its observations
            are tensors, else arrays. It may be wrapped, as by `VectorElevationMapObservation`. It is reset at once.
        max_episode_length: steps after which the environment truncates. None: the unwrapped environment's
            `max_episode_length`, or its `spec.max_episode_steps`.
        cfg: what rsl-rl logs as the environment's config.
        seed: of the reset.

    Raises:
        TypeError: for what is no `VectorEnv`, or gives neither tensors nor arrays.
        ValueError: for another autoreset mode, other actions, nested observations, or an unknown length of episodes.
    """

    def __init__(
        self, env: VectorEnv, *, max_episode_length: int | None = None, cfg: Any = None, seed: int | None = None
    ) -> None:
        hint = "wrap single ones in gymnasium.vector.SyncVectorEnv"
        require(isinstance(env, VectorEnv), "env", "must be a VectorEnv", type(env).__name__, hint, TypeError)
        mode, hint = env.metadata.get("autoreset_mode", "none"), "make it with autoreset_mode=AutoresetMode.SAME_STEP"
        require(mode is AutoresetMode.SAME_STEP, "env", "must reset within the step that ends an episode", mode, hint)
        actions = env.single_action_space
        is_vector = isinstance(actions, spaces.Box) and len(actions.shape) == 1
        require(is_vector, "env.single_action_space", "must be a Box (A,)", actions, "flatten it by a wrapper")
        self.env, self.num_envs, self.num_actions = env, env.num_envs, actions.shape[0]  # type: ignore[index]
        self.max_episode_length = _max_episode_length(env) if max_episode_length is None else max_episode_length
        self.cfg = {} if cfg is None else cfg
        self._observation, _ = env.reset(seed=seed)
        groups = _groups(self._observation)
        _check(groups, self.num_envs)
        first = next(iter(groups.values()))
        self._is_torch, self.device = isinstance(first, Tensor), torch.as_tensor(first).device
        self._steps = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)

    @property
    def unwrapped(self) -> VectorEnv:
        """The environment below all wrappers."""
        return self.env.unwrapped

    @property
    def episode_length_buf(self) -> Tensor:
        """Steps of the running episodes (B,)."""
        return getattr(self.unwrapped, "episode_length_buf", self._steps)

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        holds = hasattr(self.unwrapped, "episode_length_buf")
        hint = "learn with init_at_random_ep_len=False, or give the environment a tensor of this name"
        require(holds, "episode_length_buf", "must be the environment's", type(self.unwrapped).__name__, hint)
        self.unwrapped.episode_length_buf = value  # type: ignore[attr-defined]

    def get_observations(self) -> TensorDict:
        """Return the present observations as new tensors."""
        return self.group(self._observation)

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Step the environments, which begin new episodes where one ended.

        Args:
            actions: (B, A).

        Returns:
            What the next actions are chosen by, rewards (B,), ended episodes (B,) int64, extras.
        """
        given = actions if self._is_torch else actions.cpu().numpy()
        self._observation, *flags, infos = self.env.step(given)
        rewards, terminated, truncated = (torch.as_tensor(value, device=self.device) for value in flags)
        done = terminated | truncated
        self._steps.copy_(torch.where(done, 0, self._steps + 1))  # in place: see CONTRIBUTING.md on inference mode
        extras = {"time_outs": (truncated & ~terminated).float()}
        if "log" in infos:
            extras["log"] = infos["log"]
        return self.group(self._observation), rewards.to(torch.float32, copy=True), done.long(), extras

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def group(self, observation: Any) -> TensorDict:
        """Return an observation of the environment as groups of new float32 tensors."""
        tensors = {name: torch.as_tensor(value) for name, value in _groups(observation).items()}
        new = {name: value.to(torch.float32, copy=True) for name, value in tensors.items()}
        return TensorDict(new, batch_size=[self.num_envs], device=self.device)


def _groups(observation: Any) -> dict[str, Any]:
    return observation if isinstance(observation, dict) else {"policy": observation}


def _check(groups: dict[str, Any], num_envs: int) -> None:
    for name, value in groups.items():
        argument = f"observation {name!r}"
        nested = isinstance(value, dict | tuple)
        require(not nested, argument, "must be one tensor", type(value).__name__, "flatten it by a wrapper")
        is_array, kind = isinstance(value, Tensor | np.ndarray), type(value).__name__
        require(is_array, argument, "must be a tensor or an array", kind, "convert it by a wrapper", TypeError)
        shape = tuple(value.shape)
        require(shape[:1] == (num_envs,), argument, f"expected ({num_envs}, ...)", shape, "give a row per environment")


def _max_episode_length(env: VectorEnv) -> int:
    limit = getattr(env.unwrapped.spec, "max_episode_steps", None)
    length: Any = getattr(env.unwrapped, "max_episode_length", limit)
    hint = "give the steps after which the environment truncates"
    require(length is not None, "max_episode_length", "must be known", "None", hint)
    return length
