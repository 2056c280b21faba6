"""Train the task for two iterations with Isaac Lab's own script for rsl_rl, on the CPU."""

import sys

import gymnasium
from isaaclab_rl.entrypoints.api import TrainingRequest, train

PPO = "isaaclab_tasks.core.velocity.config.anymal_d.agents.rsl_rl_ppo_cfg:AnymalDRoughPPORunnerCfg"

if __name__ == "__main__":
    gymnasium.register(
        id="Map-Velocity-Rough",
        entry_point="isaaclab.envs:ManagerBasedRLEnv",
        disable_env_checker=True,
        kwargs={
            "env_cfg_entry_point": "benchmarks.quality.isaac_lab.task:MapEnvCfg",
            "rsl_rl_cfg_entry_point": PPO,
        },
    )
    on_cpu = {"device": "cpu", "hydra_args": ("agent.device=cpu",)}  # of the simulation, and of PPO
    sys.exit(train(TrainingRequest("rsl_rl", "Map-Velocity-Rough", num_envs=4, seed=0, max_iterations=2, **on_cpu)))
