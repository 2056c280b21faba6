"""Vector environments as rsl-rl steps them: whose episode an observation is of, time-outs, memory, refusals."""

import re

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper

pytest.importorskip("rsl_rl")

from rsl_rl.runners import OnPolicyRunner

from tests.gym.test_wrappers import CONFIG as MAP
from tests.gym.test_wrappers import DT, assert_map, cloud_of, pose_of
from torchelev.gym import VectorElevationMapObservation
from torchelev.gym.rsl_rl import GymVecEnv

LENGTHS = (2, 3, 5)  # steps of the environments' episodes
B = len(LENGTHS)


class Counters(VectorEnv):
    """Environments whose observations hold their episode and step, in one tensor each that they overwrite as they step.

    Environment 1 is truncated; 2 is truncated and terminates; 0 terminates.
    """

    num_envs = B
    single_action_space, action_space = spaces.Box(-1, 1, (2,)), spaces.Box(-1, 1, (B, 2))

    def __init__(self, mode=AutoresetMode.SAME_STEP, plain=False):
        box = spaces.Box(0, 100, (2,), np.float32)
        self.single_observation_space = box if plain else spaces.Dict(state=box, flag=spaces.Box(0, 1, (1,), np.int8))
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, B)
        self.metadata, self.plain = {"autoreset_mode": mode, "torch": True}, plain
        self.state, self.flag = torch.zeros(B, 2), torch.zeros(B, 1, dtype=torch.int8)
        self.reward, self.taken, self.seeds = torch.zeros(B), [], []

    def observe(self):
        return self.state if self.plain else {"state": self.state, "flag": self.flag}

    def reset(self, *, seed=None, options=None):
        self.seeds.append(seed)
        self.state.copy_(torch.tensor([[1.0, 0.0]]).expand(B, 2))
        return self.observe(), {}

    def step(self, actions):
        self.taken.append(actions)
        self.state[:, 1] += 1
        ended = self.state[:, 1] >= torch.tensor(LENGTHS)
        self.reward.copy_(self.state[:, 0] + 0.1 * self.state[:, 1])
        begun = torch.stack([self.state[:, 0] + 1, torch.zeros(B)], 1)
        self.state.copy_(torch.where(ended[:, None], begun, self.state))
        self.flag.copy_(ended[:, None])
        terminated = ended & torch.tensor([True, False, True])
        truncated = ended & torch.tensor([False, True, True])
        return self.observe(), self.reward, terminated, truncated, {"log": {"/ended": ended.float().mean()}}


def make(env=None, **options):
    return GymVecEnv(Counters() if env is None else env, **{"max_episode_length": 5, **options})


def expected_step(t):
    """By hand: episodes of n steps, one after the other, the next begun in the step that ends the last."""
    state = [[1 + t // n, t % n] for n in LENGTHS]
    done = [int(t % n == 0) for n in LENGTHS]
    reward = [1 + (t - 1) // n + 0.1 * ((t - 1) % n + 1) for n in LENGTHS]
    return state, reward, done, [0, done[1], 0]  # a termination is no time-out, even at the last step


@pytest.mark.parametrize("inference", [False, True])
def test_steps_are_those_by_hand(inference):
    env = make()
    assert env.get_observations()["state"].tolist() == [[1, 0]] * B
    for t in range(1, 13):
        actions = torch.full((B, 2), 3.0 * t)
        with torch.inference_mode(inference):
            seen, reward, done, extras = env.step(actions)
        state, expected, ended, late = expected_step(t)
        assert seen["state"].tolist() == state and seen["flag"][:, 0].tolist() == ended
        torch.testing.assert_close(reward, torch.tensor(expected))
        assert done.tolist() == ended and done.dtype == torch.int64
        assert extras["time_outs"].tolist() == late and extras["time_outs"].dtype == torch.float32
        assert float(extras["log"]["/ended"]) == pytest.approx(sum(ended) / B)
        assert env.episode_length_buf.tolist() == [t % n for n in LENGTHS]
        assert env.env.taken[-1] is actions, "without bounds, as the policy drew them"
        torch.testing.assert_close(env.get_observations()["state"], seen["state"])


def test_attributes():
    env = make(seed=7, cfg={"name": "counters"})
    assert (env.num_envs, env.num_actions, env.max_episode_length) == (B, 2, 5)
    assert env.device == torch.device("cpu") and env.cfg == {"name": "counters"} and env.unwrapped.seeds == [7]
    seen = env.get_observations()
    assert seen.batch_size == (B,) and all(value.dtype == torch.float32 for value in seen.values())
    assert make(Counters(plain=True)).get_observations()["policy"].shape == (B, 2)


def test_what_is_returned_does_not_change_with_the_next_step():
    """PPO keeps a reference to the observation across a step."""
    env = make()
    first = env.get_observations()
    seen, reward, _, _ = env.step(torch.zeros(B, 2))
    kept, paid = [first, seen, env.get_observations()], reward.clone()
    before = [one["state"].clone() for one in kept]
    env.step(torch.zeros(B, 2))
    assert torch.equal(reward, paid) and not torch.equal(env.unwrapped.reward, paid)
    for one, state in zip(kept, before, strict=True):
        assert torch.equal(one["state"], state)
    kept[-1]["state"].fill_(7)
    assert not (env.get_observations()["state"] == 7).any()


def test_observations_of_inference_mode_can_be_used_outside():
    env = make()
    with torch.inference_mode():
        env.step(torch.zeros(B, 2))
    seen = env.get_observations()
    assert not seen["state"].is_inference()
    seen["state"].add_(1)
    env.step(torch.zeros(B, 2))


class Counted(Counters):
    """Holds its episodes' lengths itself, as environments of Isaac Lab do."""

    max_episode_length = 9

    def __init__(self):
        super().__init__()
        self.episode_length_buf = torch.tensor([4, 5, 6])


def test_lengths_of_episodes_that_the_environment_holds():
    env = GymVecEnv(VectorWrapper(Counted()))
    assert env.max_episode_length == 9 and env.episode_length_buf.tolist() == [4, 5, 6]
    env.episode_length_buf = torch.tensor([1, 2, 3])
    assert env.unwrapped.episode_length_buf.tolist() == [1, 2, 3] == env.episode_length_buf.tolist()
    assert GymVecEnv(Counted(), max_episode_length=3).max_episode_length == 3


def test_lengths_that_are_counted_cannot_be_set():
    env = make()
    with pytest.raises(ValueError, match="episode_length_buf: must be the environment's, got Counters; learn with"):
        env.episode_length_buf = torch.ones(B, dtype=torch.int64)


def test_the_limit_of_a_spec():
    env = Counters()
    env.spec = gymnasium.envs.registration.EnvSpec("torchelev-test/Counters-v0", Counters, max_episode_steps=11)
    assert GymVecEnv(env).max_episode_length == 11


class OfArrays(gymnasium.Env):
    observation_space, action_space = spaces.Box(0, 100, (2,), np.float64), spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, length):
        self.length, self.episode, self.count = length, 0, 0

    def reset(self, *, seed=None, options=None):
        self.episode, self.count = self.episode + 1, 0
        return np.array([self.episode, 0.0]), {}

    def step(self, action):
        assert isinstance(action, np.ndarray)
        self.count += 1
        return np.array([self.episode, self.count], float), 1.0 + action[0], False, self.count >= self.length, {}


def of_arrays():
    return SyncVectorEnv([lambda n=n: OfArrays(n) for n in LENGTHS], autoreset_mode=AutoresetMode.SAME_STEP)


def test_environments_of_arrays():
    env = make(of_arrays())
    for t in range(1, 7):
        with torch.inference_mode():
            seen, reward, done, extras = env.step(torch.full((B, 2), 0.5))
        state, _, ended, _ = expected_step(t)
        assert reward.tolist() == [1.5] * B and reward.dtype == torch.float32
        assert seen["policy"].tolist() == state and done.tolist() == ended == extras["time_outs"].tolist()


REFUSED = {
    "env: must be a VectorEnv, got OfArrays; wrap": lambda: OfArrays(2),
    r"env: must reset within the step that ends an episode, got AutoresetMode.NEXT_STEP; make it with": lambda: (
        Counters(AutoresetMode.NEXT_STEP)
    ),
    "env: must reset within .*got AutoresetMode.DISABLED; make it with": lambda: Counters(AutoresetMode.DISABLED),
    "observation 'flag': must be a tensor or an array, got list; convert": lambda: changed(flag=[[0], [0], [0]]),
}


@pytest.mark.parametrize("message", REFUSED)
def test_refuses_other_environments(message):
    with pytest.raises((TypeError, ValueError), match=message):
        make(REFUSED[message]())


def changed(**attributes):
    env = Counters()
    for name, value in attributes.items():
        setattr(env, name, value)
    return env


def test_refuses_what_rsl_rl_cannot_take():
    with pytest.raises(ValueError, match=re.escape("env.single_action_space: must be a Box (A,), got Discrete(2); ")):
        make(changed(single_action_space=spaces.Discrete(2)))
    with pytest.raises(ValueError, match=r"env.single_action_space: must be a Box \(A,\), got Box\(-1.0, 1.0, \(2, 2"):
        make(changed(single_action_space=spaces.Box(-1, 1, (2, 2))))
    with pytest.raises(ValueError, match="max_episode_length: must be known, got None; give the steps"):
        GymVecEnv(Counters())
    with pytest.raises(ValueError, match="observation 'flag': must be one tensor, got dict; flatten"):
        make(changed(flag={"inner": torch.zeros(B)}))
    with pytest.raises(ValueError, match=re.escape("observation 'flag': expected (3, ...), got (2, 1); give one row")):
        make(changed(flag=torch.zeros(2, 1)))
    with pytest.raises(ValueError, match=re.escape("observation 'flag': expected (3, ...), got (); give one row")):
        make(changed(flag=torch.zeros(())))


def clouds(env):
    return torch.from_numpy(np.stack([cloud_of(i, *env.unwrapped.state[i].int().tolist()) for i in range(B)]))


def poses(env):
    return torch.from_numpy(np.stack([pose_of(int(count)) for count in env.unwrapped.state[:, 1]]))


def mapped():
    maps = dict(points=clouds, T_map_sensor=poses, T_map_base=poses, dt=DT, cfg=MAP)
    return make(VectorElevationMapObservation(Counters(), **maps))


def test_a_map_below():
    env = mapped()
    for _ in range(6):
        with torch.inference_mode():
            seen = env.step(torch.zeros(B, 2))[0]
        for i in range(B):
            assert_map(env.env, seen["map"][i], i, i, *seen["state"][i].int().tolist())


def test_ppo_trains_and_stores_what_the_policy_saw():
    cnn = {"output_channels": [2], "kernel_size": 3, "stride": 2, "padding": "zeros", "activation": "elu"}
    model = {"class_name": "CNNModel", "hidden_dims": [8], "activation": "elu", "cnn_cfg": cnn}
    gaussian = {"class_name": "GaussianDistribution", "init_std": 1.0}
    settings = {
        "num_steps_per_env": 4,
        "save_interval": 100,
        "obs_groups": {name: ["state", "map"] for name in ("actor", "critic")},
        "algorithm": {"class_name": "PPO"},
        "actor": model | {"cnn_cfg": dict(cnn), "distribution_cfg": gaussian},
        "critic": model,
    }
    env = mapped()
    runner = OnPolicyRunner(env, settings)
    before = [value.clone() for value in runner.alg.get_policy().parameters()]
    runner.learn(2)
    assert any(not torch.equal(a, b) for a, b in zip(before, runner.alg.get_policy().parameters(), strict=True))
    stored = runner.alg.storage.observations["state"][:, :, :].tolist()
    assert stored == [[[1 + t // n, t % n] for n in LENGTHS] for t in range(4, 8)]
