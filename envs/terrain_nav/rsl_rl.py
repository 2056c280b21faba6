"""TerrainNav as rsl-rl steps it: a `VecEnv` that resets its environments itself, with TensorDict observations."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from envs.terrain_nav.task import ASIDE, NUM_ACTIONS, TerrainNav


class RslRlTerrainNav(VecEnv):
    """A `TerrainNav` for `rsl_rl.runners.OnPolicyRunner` (rsl-rl-lib 5.4 and 5.5).

    Observation groups: "policy" and "map" for the actor, "policy" and "truth" for the critic. `extras` holds
    "time_outs" (B,) and "log": shares of the last finished episodes that ended in each way.
    """

    def __init__(self, task: TerrainNav) -> None:
        self.task = task
        self.num_envs, self.num_actions, self.device = task.num_envs, NUM_ACTIONS, task.device
        self.max_episode_length = task.cfg.max_episode_length
        self.cfg = dataclasses.asdict(task.cfg)

    @property
    def episode_length_buf(self) -> Tensor:
        """Steps of the running episodes (B,)."""
        return self.task.episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        self.task.episode_length.copy_(value)

    def get_observations(self) -> TensorDict:
        """Return the present observations."""
        return TensorDict(self.task.observe(), batch_size=[self.num_envs], device=self.device)

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Move, begin new episodes where one ended, look, and return what the next action is chosen by."""
        outcome = self.task.advance(actions)
        self.task.reset(outcome.done)
        self.task.sense()
        log = {f"/{name}": share for name, share in self.task.shares.items()}
        extras = {"time_outs": outcome.truncated.float(), "log": log}
        return self.get_observations(), outcome.reward, outcome.done.long(), extras


def mirror(
    env: VecEnv, obs: TensorDict | None = None, actions: Tensor | None = None
) -> tuple[TensorDict | None, Tensor | None]:
    """Append to N samples the same with left and right exchanged (2N): rsl-rl's `data_augmentation_func`.

    The task looks the same in a mirror as long as the cameras do, so that each step teaches twice. After Mittal et al.,
    "Symmetry Considerations for Learning Task Symmetric Robot Policies" (ICRA 2024).
    """
    if obs is not None:
        seen = {name: image.flip(-1) for name, image in obs.items() if name != "policy"}  # columns grow with y
        seen["policy"] = _turned(obs["policy"], ASIDE)
        obs = torch.cat([obs, TensorDict(seen, batch_size=obs.batch_size)])
    if actions is not None:
        actions = torch.cat([actions, _turned(actions, (1,))])
    return obs, actions


def _turned(values: Tensor, which: tuple[int, ...]) -> Tensor:
    sign = torch.ones(values.shape[-1], device=values.device)
    sign[list(which)] = -1.0
    return values * sign
