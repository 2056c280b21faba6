"""TerrainNav through gymnasium: one environment and many, with their resets."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import envs  # noqa: F401  (registers)
from envs.terrain_nav import CourseConfig, TerrainNav, TerrainNavConfig
from envs.terrain_nav.render import save_strip, snapshot

CFG = TerrainNavConfig(course=CourseConfig(num_tiles=2, num_routes=8), episode_length=1.0)
ID = "torchelev/TerrainNav-v0"


@pytest.mark.slow(1)
@pytest.mark.parametrize("perception", ["map", "truth", "blind"])
def test_check_env(perception):
    env = gymnasium.make(ID, cfg=CFG, perception=perception)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*infinity.*")  # heights have no bounds
        check_env(env.unwrapped)


def test_an_episode_of_arrays():
    env = gymnasium.make(ID, cfg=CFG)
    observation, info = env.reset(seed=0)
    assert observation["policy"].dtype == np.float32 and observation["map"].shape == (4, 16, 16)
    steps, over = 0, False
    while not over:
        observation, reward, terminated, truncated, info = env.step(np.array([0.0, 1.0], np.float32))
        over, steps = terminated or truncated, steps + 1
    assert steps == 5 and truncated and isinstance(reward, float) and info["distance"] > 0.4


@pytest.mark.slow(1)
def test_render_draws_ground_and_map():
    env = gymnasium.make(ID, cfg=CFG, render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.dtype == np.uint8 and picture.shape == (320, 640, 3)
    env.step(np.array([1.0, 0.0], np.float32))
    assert (env.render() != picture).any()
    assert gymnasium.make(ID, cfg=CFG).unwrapped.render() is None


def test_a_snapshot_does_not_change_with_the_next_step():
    task = TerrainNav(CFG, 1, perception="blind")
    shot = snapshot(task)
    kept = [np.array(value, copy=True) for value in (shot.xy, shot.goal, shot.footprint)]
    task.advance(torch.ones(1, 2))
    task.reset()
    for value, before in zip((shot.xy, shot.goal, shot.footprint), kept, strict=True):
        np.testing.assert_array_equal(value, before)


def test_make_vec_gives_tensors_and_declares_its_autoreset():
    env = gymnasium.make_vec(ID, num_envs=3, cfg=CFG)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observation, info = env.reset(seed=4)
    again, _ = env.reset(seed=4)
    assert torch.equal(observation["map"], again["map"]) and observation["policy"].shape == (3, 12)
    assert env.observation_space["map"].shape == (3, 4, 16, 16) and env.action_space.shape == (3, 2)


def test_an_ended_episode_begins_anew_in_the_next_step():
    env = gymnasium.make_vec(ID, num_envs=3, cfg=CFG, perception="truth")
    env.reset(seed=4)
    for step in range(1, 14):
        _, reward, terminated, truncated, _ = env.step(torch.tensor([[0.0, 1.0]] * 3))
        ends, begins = step % 6 == 5, step % 6 == 0
        assert bool(truncated.all()) == ends and not bool(terminated.any())
        assert bool((reward == 0).all()) == begins
        assert (env.unwrapped.task.episode_length == (0 if begins else step % 6)).all()


@pytest.mark.slow(1)
@pytest.mark.parametrize("limit, length", [(None, 5), (3, 3), (9, 5)])
def test_an_ended_episode_begins_anew_in_the_same_step(limit, length):
    options = dict(max_episode_steps=limit, autoreset_mode=AutoresetMode.SAME_STEP)
    env = gymnasium.make_vec(ID, num_envs=3, cfg=CFG, **options)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP and env.unwrapped.max_episode_length == length
    assert gymnasium.make_vec(ID, num_envs=1, cfg=CFG).metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    seen, _ = env.reset(seed=4)
    for step in range(1, 11):
        goal = seen["policy"][:, 2]
        seen, reward, terminated, truncated, info = env.step(torch.tensor([[0.0, 1.0]] * 3))
        assert bool(truncated.all()) == (step % length == 0) and not bool(terminated.any())
        assert env.unwrapped.episode_length_buf.tolist() == [step % length] * 3 and bool((reward != 0).all())
        final = info["final_obs"]["policy"]
        assert torch.equal(info["_final_obs"], truncated)
        assert torch.equal(final, seen["policy"]) == (step % length != 0), "where it ended, and where it began"
        assert bool(((final[:, 2] - goal).abs() < 0.1).all()), "a step from the goal's distance before"


def test_final_observations_can_be_left_out():
    env = gymnasium.make_vec(ID, num_envs=1, cfg=CFG, autoreset_mode=AutoresetMode.SAME_STEP, final_obs=False)
    env.reset(seed=4)
    assert "final_obs" not in env.step(torch.zeros(1, 2))[-1]


def test_refuses_an_autoreset_mode():
    with pytest.raises(ValueError, match="autoreset_mode: must be NEXT_STEP or SAME_STEP, got AutoresetMode.DISABLED"):
        gymnasium.make_vec(ID, num_envs=1, cfg=CFG, autoreset_mode=AutoresetMode.DISABLED)


def test_the_critic_s_observation_is_in_the_space():
    env = gymnasium.make_vec(ID, num_envs=3, cfg=CFG, critic=True)
    seen, _ = env.reset(seed=4)
    assert set(seen) == set(env.observation_space) == {"policy", "map", "truth"}
    assert seen["truth"].shape == env.observation_space["truth"].shape


def test_a_limit_of_steps_and_a_reset_of_some():
    env = gymnasium.make_vec(ID, num_envs=3, cfg=CFG, perception="blind", max_episode_steps=3)
    env.reset(seed=4)
    for step in range(1, 4):
        truncated = env.step(torch.zeros(3, 2))[3]
        assert bool(truncated.all()) == (step == 3)
    mask = np.array([True, False, False])
    env.reset(options={"reset_mask": mask})
    task = env.unwrapped.task
    assert task.episode_length.tolist() == [0, 3, 3]
    env.step(torch.zeros(3, 2))
    assert task.episode_length.tolist() == [1, 0, 0]


def test_a_reset_of_some_leaves_what_the_others_see():
    env = gymnasium.make_vec(ID, num_envs=3, cfg=CFG)
    env.reset(seed=4)
    before = {name: value.clone() for name, value in env.step(torch.ones(3, 2))[0].items()}
    emap = env.unwrapped.task.sight.emap
    layers = {name: emap.layer(name).nan_to_num() for name in ("elevation", "variance", "time")}
    after, _ = env.reset(options={"reset_mask": np.array([False, True, False])})
    for name, value in after.items():
        assert torch.equal(value[::2], before[name][::2]) and not torch.equal(value[1], before[name][1]), name
    for name, value in layers.items():
        assert torch.equal(emap.layer(name).nan_to_num()[::2], value[::2]), name


@pytest.mark.slow(1)
def test_environments_without_a_seed_differ():
    seen = [gymnasium.make(ID, cfg=CFG, perception="blind").reset()[0]["policy"] for _ in range(3)]
    assert (seen[0] != seen[1]).any() and (seen[1] != seen[2]).any()
    gymnasium.make(ID, cfg=CFG, perception="blind").reset(seed=2**62)


@pytest.mark.slow(2)
def test_a_strip_shows_ground_and_map_in_one_extent(tmp_path, figures):
    task = TerrainNav(CFG, 1)
    shots = [snapshot(task)]
    task.advance(torch.ones(1, 2))
    task.sense()
    shots.append(snapshot(task))
    save_strip(shots, tmp_path / "strip.png", trail=[shot.xy for shot in shots], cfg=CFG)
    axes = [ax for ax in figures[0].axes if ax.images]
    assert len(axes) == 4 and len({(*ax.get_xlim(), *ax.get_ylim()) for ax in axes}) == 1
    x_min, x_max, y_min, y_max = *axes[0].get_xlim(), *axes[0].get_ylim()
    places = np.array([*(shot.xy for shot in shots), shots[0].goal])
    margins = np.concatenate([places.min(0) - [x_min, y_min], [x_max, y_max] - places.max(0)])
    assert margins.min() == pytest.approx(1.2), "as close as the path and the goal allow"


@pytest.mark.parametrize("num_envs", [-3, 0])
def test_a_number_of_robots_that_is_not_positive_is_refused(num_envs):
    with pytest.raises(
        ValueError, match=f"num_envs: must be a positive int, got {num_envs}; give the number of robots"
    ):
        gymnasium.make_vec(ID, num_envs=num_envs, cfg=CFG)
