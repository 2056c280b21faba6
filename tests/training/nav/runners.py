"""A small task and its runner for the tests of the training."""

import torch

import training.nav.train as nav
from envs.terrain_nav import CourseConfig, TerrainNav, TerrainNavConfig
from envs.terrain_nav.rsl_rl import RslRlTerrainNav
from training.runner import ResumableRunner

CFG = TerrainNavConfig(course=CourseConfig(num_tiles=2, num_routes=8), episode_length=2.0)


def make_runner(folder, perception="map", cfg=CFG, num_envs=4, seed=0, encoder="cnn"):
    torch.manual_seed(seed)
    task = TerrainNav(cfg, num_envs, perception=perception, seed=seed)
    settings = nav.ppo_config(num_steps=6, save_interval=100, encoder=encoder)
    return ResumableRunner(RslRlTerrainNav(task), settings, str(folder) if folder else None)


def weights(runner):
    return {name: value.clone() for name, value in runner.alg.get_policy().state_dict().items()}
