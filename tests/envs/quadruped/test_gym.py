"""The quadruped through gymnasium and rsl-rl."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import envs  # noqa: F401  (registers)
from envs.quadruped import Quadruped
from envs.quadruped.rsl_rl import RslRlQuadruped
from tests.envs.quadruped.cases import CFG

ID = "torchelev/Quadruped-v0"


@pytest.mark.slow(1)
@pytest.mark.parametrize("perception", ["map", "truth", "blind"])
def test_check_env(perception):
    env = gymnasium.make(ID, cfg=CFG, perception=perception)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*infinity.*")  # heights have no bounds
        check_env(env.unwrapped, skip_render_check=True)


def test_make_vec_steps_and_resets():
    env = gymnasium.make_vec(ID, num_envs=3, cfg=CFG, perception="truth", max_episode_steps=3)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observation, info = env.reset(seed=0)
    assert observation["height_scan"].shape == (3, 187) and observation["feet"].shape == (3, 56)
    ends = []
    for _ in range(4):
        observation, reward, terminated, truncated, info = env.step(torch.zeros(3, 12))
        ends.append(truncated.all().item())
    assert ends == [False, False, True, False] and set(info) >= {"level", "crossed", "fallen", "timed_out"}


def test_a_single_environment_gives_arrays():
    env = gymnasium.make(ID, cfg=CFG, perception="blind")
    observation, info = env.reset(seed=0)
    assert observation["policy"].dtype == np.float32 and env.action_space.shape == (12,)
    *_, info = env.step(np.zeros(12, np.float32))
    assert info["fallen"] is False and info["level"] in (0, 1)


def test_rsl_rl_gets_the_groups_and_time_outs():
    env = RslRlQuadruped(Quadruped(CFG, 2, perception="truth"))
    groups = env.get_observations()
    assert set(groups.keys()) == {
        "policy", "height_scan", "feet", "privileged", "true_height_scan", "true_feet",
    }  # fmt: skip
    env.episode_length_buf = torch.tensor([env.max_episode_length - 1, 0])
    _, _, dones, extras = env.step(torch.zeros(2, 12))
    assert dones.tolist() == [1, 0] and extras["time_outs"].tolist() == [1, 0]


@pytest.mark.parametrize("num_envs", [-3, 0])
def test_a_number_of_robots_that_is_not_positive_is_refused(num_envs):
    with pytest.raises(
        ValueError, match=f"num_envs: must be a positive int, got {num_envs}; give the number of robots"
    ):
        gymnasium.make_vec(ID, num_envs=num_envs, cfg=CFG)
