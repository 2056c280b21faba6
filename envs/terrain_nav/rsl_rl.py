"""TerrainNav as rsl-rl steps it, and its mirror image."""

from __future__ import annotations

import dataclasses

import torch
from gymnasium.vector import AutoresetMode
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from envs.terrain_nav.gym import TerrainNavVectorEnv
from envs.terrain_nav.task import ASIDE, TerrainNav
from torchelev.gym.rsl_rl import GymVecEnv


class RslRlTerrainNav(GymVecEnv):
    """A `TerrainNav` for `rsl_rl.runners.OnPolicyRunner` (rsl-rl-lib 5.4 and 5.5).

    Observation groups: "policy" and "map" for the actor, "policy" and "truth" for the critic. `extras` holds
    "time_outs" (B,) and "log": shares of the last finished episodes that ended in each way.
    """

    def __init__(self, task: TerrainNav) -> None:
        self.task = task
        env = TerrainNavVectorEnv(task=task, autoreset_mode=AutoresetMode.SAME_STEP, critic=True, final_obs=False)
        super().__init__(env, cfg=dataclasses.asdict(task.cfg))

    def get_observations(self) -> TensorDict:
        """Return the present observations, read anew: a resume changes the task between two steps."""
        return self.group(self.task.observe())


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
