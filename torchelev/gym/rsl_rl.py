"""Train on any gymnasium vector environment with rsl-rl: a `VecEnv` with TensorDict observations.

To add a map and train with rsl-rl's runner:

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

    Each entry of a Dict observation becomes an observation group (B, ...) in float32; any other observation becomes the
    group "policy". Returned tensors share no memory with the environment, as PPO keeps observations across steps.
    `extras` holds "time_outs" (B,), 1 for episodes truncated but not terminated, and `infos["log"]` if the environment
    returns it. Actions are passed on as the policy draws them, unclipped.

    If the unwrapped environment has a tensor `episode_length_buf` (B,), it is read and set. Otherwise the wrapper
    counts the steps and they cannot be set: learn with `init_at_random_ep_len=False`.

    If your environment changes between steps, for instance by loading a checkpoint, override `get_observations`.

    Args:
        env: a vector environment in `AutoresetMode.SAME_STEP` whose action space is a Box (A,). It gets actions as
            tensors if its observations are tensors, else as arrays. It may be wrapped, for instance in
            `VectorElevationMapObservation`. It is reset at once.
        max_episode_length: number of steps after which the environment truncates. None: `max_episode_length` of the
            unwrapped environment, or its `spec.max_episode_steps`.
        cfg: the environment's config that rsl-rl logs.
        seed: seed of the reset.

    Raises:
        TypeError: if `env` is no `VectorEnv`, or returns neither tensors nor arrays.
        ValueError: for another autoreset mode or action space, nested observations, or an unknown episode length.
    """

    def __init__(
        self, env: VectorEnv, *, max_episode_length: int | None = None, cfg: Any = None, seed: int | None = None
    ) -> None:
        hint = "wrap single ones in gymnasium.vector.SyncVectorEnv"
        require(isinstance(env, VectorEnv), "env", "must be a VectorEnv", type(env).__name__, hint, TypeError)
        mode, hint = env.metadata.get("autoreset_mode", "none"), "make it with autoreset_mode=AutoresetMode.SAME_STEP"
        require(mode is AutoresetMode.SAME_STEP, "env", "must reset within the step that ends an episode", mode, hint)
        actions = env.single_action_space
        is_flat = isinstance(actions, spaces.Box) and len(actions.shape) == 1
        require(is_flat, "env.single_action_space", "must be a Box (A,)", actions, "flatten it with a wrapper")
        self.env, self.num_envs, self.num_actions = env, env.num_envs, actions.shape[0]  # type: ignore[index]
        self.max_episode_length = _find_episode_length(env) if max_episode_length is None else max_episode_length
        self.cfg = {} if cfg is None else cfg
        self._observation, _ = env.reset(seed=seed)
        groups = _as_groups(self._observation)
        _check_groups(groups, self.num_envs)
        first = next(iter(groups.values()))
        self._is_torch, self.device = isinstance(first, Tensor), torch.as_tensor(first).device
        self._steps = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)

    @property
    def unwrapped(self) -> VectorEnv:
        """The environment without its wrappers."""
        return self.env.unwrapped

    @property
    def episode_length_buf(self) -> Tensor:
        """Number of steps (B,) of the current episodes."""
        return getattr(self.unwrapped, "episode_length_buf", self._steps)

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        can_set = hasattr(self.unwrapped, "episode_length_buf")
        hint = "learn with init_at_random_ep_len=False, or give the environment a tensor of this name"
        require(can_set, "episode_length_buf", "must be the environment's", type(self.unwrapped).__name__, hint)
        self.unwrapped.episode_length_buf = value  # type: ignore[attr-defined]

    def get_observations(self) -> TensorDict:
        """Return the current observations as new tensors."""
        return self.group(self._observation)

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Step the environments, and start a new episode where one ended.

        Args:
            actions: (B, A).

        Returns:
            Observations, of the new episode where one ended; rewards (B,); ended episodes (B,) int64; extras.
        """
        given = actions if self._is_torch else actions.cpu().numpy()
        self._observation, *results, infos = self.env.step(given)
        rewards, terminated, truncated = (torch.as_tensor(value, device=self.device) for value in results)
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
        """Convert an observation of the environment to groups of new float32 tensors."""
        tensors = {name: torch.as_tensor(value) for name, value in _as_groups(observation).items()}
        new = {name: value.to(torch.float32, copy=True) for name, value in tensors.items()}
        return TensorDict(new, batch_size=[self.num_envs], device=self.device)


def _as_groups(observation: Any) -> dict[str, Any]:
    return observation if isinstance(observation, dict) else {"policy": observation}


def _check_groups(groups: dict[str, Any], num_envs: int) -> None:
    for name, value in groups.items():
        argument = f"observation {name!r}"
        is_nested = isinstance(value, dict | tuple)
        require(not is_nested, argument, "must be one tensor", type(value).__name__, "flatten it with a wrapper")
        is_array, kind = isinstance(value, Tensor | np.ndarray), type(value).__name__
        require(is_array, argument, "must be a tensor or an array", kind, "convert it with a wrapper", TypeError)
        shape, hint = tuple(value.shape), "give one row per environment"
        require(shape[:1] == (num_envs,), argument, f"expected ({num_envs}, ...)", shape, hint)


def _find_episode_length(env: VectorEnv) -> int:
    limit = getattr(env.unwrapped.spec, "max_episode_steps", None)
    length: Any = getattr(env.unwrapped, "max_episode_length", limit)
    hint = "give the steps after which the environment truncates"
    require(length is not None, "max_episode_length", "must be known", "None", hint)
    return length
