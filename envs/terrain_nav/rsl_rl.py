"""TerrainNav for rsl-rl, and its mirror symmetry for data augmentation."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from gymnasium.vector import AutoresetMode
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from envs.terrain_nav.gym import TerrainNavVectorEnv
from envs.terrain_nav.proprioception import LATERAL
from envs.terrain_nav.task import TerrainNav
from torchelev.gym.rsl_rl import GymVecEnv


class RslRlTerrainNav(GymVecEnv):
    """A `TerrainNav` for `rsl_rl.runners.OnPolicyRunner` (rsl-rl-lib 5.4 and 5.5).

    The observation groups are "policy" and "map" for the actor, "policy" and "truth" for the critic. `extras` holds
    "time_outs" (B,), and in "log" how large a fraction of the last finished episodes ended in each way.
    """

    def __init__(self, task: TerrainNav) -> None:
        self.task = task
        env = TerrainNavVectorEnv(task=task, autoreset_mode=AutoresetMode.SAME_STEP, critic=True, final_obs=False)
        super().__init__(env, cfg=dataclasses.asdict(task.cfg))

    def get_observations(self) -> TensorDict:
        """Return the current observations, computed anew, as resuming a training changes the task between two steps."""
        return self.group(self.task.observe())


def mirror(
    env: VecEnv, obs: TensorDict | None = None, actions: Tensor | None = None
) -> tuple[TensorDict | None, Tensor | None]:
    """Append to N samples their mirror images (2N): rsl-rl's `data_augmentation_func`.

    The task is symmetric in left and right as long as the cameras are. After Mittal et al., "Symmetry Considerations
    for Learning Task Symmetric Robot Policies" (ICRA 2024).
    """
    if obs is not None:
        mirrored = {name: image.flip(-1) for name, image in obs.items() if name != "policy"}  # columns grow with y
        mirrored["policy"] = _negate(obs["policy"], LATERAL)
        both: Any = torch.cat([obs, TensorDict(mirrored, batch_size=obs.batch_size)])
        obs = both
    if actions is not None:
        actions = torch.cat([actions, _negate(actions, (1,))])
    return obs, actions


def _negate(values: Tensor, entries: tuple[int, ...]) -> Tensor:
    """Return values (..., M) with the sign of some entries changed."""
    sign = torch.ones(values.shape[-1], device=values.device)
    sign[list(entries)] = -1.0
    return values * sign
