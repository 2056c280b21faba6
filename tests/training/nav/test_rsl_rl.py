"""TerrainNav as a vectorized environment of rsl-rl."""

import dataclasses

import pytest
import torch

from envs.terrain_nav import TerrainNav
from envs.terrain_nav.rsl_rl import RslRlTerrainNav
from tests.training.nav.runners import CFG


def test_a_vec_env_of_rsl_rl():
    env = RslRlTerrainNav(TerrainNav(CFG, 4, perception="truth"))
    seen = env.get_observations()
    assert set(seen.keys()) == {"policy", "map", "truth"} and seen.batch_size == (4,)
    for step in range(1, 11):
        seen, reward, done, extras = env.step(torch.tensor([[0.0, 1.0]] * 4))
        assert reward.shape == done.shape == extras["time_outs"].shape == (4,)
        assert bool(done.all()) == (step == 10)
    assert extras["time_outs"].tolist() == [1.0] * 4 and float(extras["log"]["/truncated"]) == 1.0
    assert env.episode_length_buf.tolist() == [0] * 4
    env.task.goal.copy_(env.task.xy)
    _, _, done, extras = env.step(torch.zeros(4, 2))
    assert bool(done.all()) and not bool(extras["time_outs"].any()), "a success is no time-out"
    env.episode_length_buf = torch.tensor([1, 2, 3, 4])
    assert env.task.episode_length.tolist() == [1, 2, 3, 4]


@pytest.mark.slow(1)
def test_its_steps_are_those_of_the_task():
    one, other = (TerrainNav(CFG, 3, seed=5) for _ in range(2))
    env = RslRlTerrainNav(one)
    other.reset()
    other.sense()
    for step in range(1, 12):  # an episode has ten
        actions = torch.tensor([[1.0, 0.1 * step], [0.5, -1.0], [0.0, 0.0]])
        seen, reward, done, extras = env.step(actions)
        outcome = other.advance(actions)
        other.reset(outcome.done)
        other.sense()
        for name, expected in other.observe().items():
            assert torch.equal(seen[name], expected), name
        assert torch.equal(reward, outcome.reward) and torch.equal(done, outcome.done.long())
        assert torch.equal(extras["time_outs"], outcome.truncated.float())
        assert extras["log"] == {f"/{name}": share for name, share in other.ending_fractions.items()}
    assert env.cfg == dataclasses.asdict(CFG) and env.max_episode_length == 10
    other.reset()
    one.load_state_dict(other.state_dict())
    for name, expected in other.observe().items():
        assert torch.equal(env.get_observations()[name], expected), f"{name} is not read anew"


def test_it_steps_in_inference_mode_and_outside_in_turn():
    env = RslRlTerrainNav(TerrainNav(CFG, 2))
    for _ in range(2):
        with torch.inference_mode():
            env.step(torch.zeros(2, 2))
        env.step(torch.zeros(2, 2))
        env.task.reset()
