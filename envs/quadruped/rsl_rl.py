"""The quadruped for rsl-rl."""

from __future__ import annotations

import dataclasses

from gymnasium.vector import AutoresetMode
from tensordict import TensorDict

from envs.quadruped.gym import QuadrupedVectorEnv
from envs.quadruped.task import Quadruped
from torchelev.gym.rsl_rl import GymVecEnv


class RslRlQuadruped(GymVecEnv):
    """A `Quadruped` for `rsl_rl.runners.OnPolicyRunner` (rsl-rl-lib 5.4 and 5.5).

    The observation groups are "policy", "height_scan" and "feet" for the actor; "privileged", "true_height_scan" and
    "true_feet" are for the critic. `extras` holds "time_outs" (B,), and in "log" how large a fraction of the last
    finished episodes ended in each way.
    """

    def __init__(self, task: Quadruped) -> None:
        self.task = task
        env = QuadrupedVectorEnv(task=task, autoreset_mode=AutoresetMode.SAME_STEP, critic=True, final_obs=False)
        super().__init__(env, cfg=dataclasses.asdict(task.cfg))

    def get_observations(self) -> TensorDict:
        """Return the current observations, computed anew, as resuming a training changes the task between two steps."""
        return self.group(self.task.observe())
