"""The map in gymnasium's observations: whose episode it is of, in every autoreset mode; kinds of arrays; refusals."""

import copy
import dataclasses
import doctest
import pickle

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import Autoreset

import torchelev.gym.wrappers
from tests.devices import OneDevice
from tests.helpers import small_config
from torchelev import ElevationMap, ElevationMapConfig, GridConfig, HeightScan, MapImage
from torchelev.gym import ElevationMapObservation, VectorElevationMapObservation
from torchelev.gym.feed import DEFAULT_READ

CONFIG = small_config((24, 24))
DT = 0.5  # [s]
LENGTHS = (2, 3, 5)  # steps of the environments' episodes
LAYERS = ("elevation", "variance", "time", "upper_bound", "traversability", "validity")


def cloud_of(index, episode, step):
    """Ground whose height encodes the environment and the episode; no two clouds are alike."""
    xy = np.random.default_rng((index, episode, step)).uniform(-0.6, 0.6, (300, 2))
    return np.concatenate([xy, np.full((300, 1), 0.1 * episode + 0.01 * index - 1.0)], 1)


def pose_of(step):
    T = np.eye(4)
    T[0, 3], T[2, 3] = 0.03 * step, 1.0
    return T


class Ground(gymnasium.Env):
    """Its observation holds its episode and its step, and so does the ground that it sees."""

    observation_space = spaces.Box(0, 100, (2,), np.float32)
    action_space = spaces.Discrete(2)
    metadata = {"render_modes": []}

    def __init__(self, index=0, length=1000):
        self.index, self.length, self.episode, self.count = index, length, 0, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode = 1 if seed is not None else self.episode + 1
        self.count = 0
        return self._observation(), {}

    def step(self, action):
        self.count += 1
        ended, late = self.count >= self.length, self.index == 1  # one is truncated, the others terminate
        return self._observation(), 0.0, ended and not late, ended and late, {}

    def _observation(self):
        return np.array([self.episode, self.count], np.float32)

    def cloud(self):
        return cloud_of(self.index, self.episode, self.count)

    def pose(self):
        return pose_of(self.count)


def cloud(env):
    return env.unwrapped.cloud()


def pose(env):
    return env.unwrapped.pose()


def clouds(envs):
    return envs.call("cloud")


def poses(envs):
    return np.stack(envs.call("pose"))


SINGLE = dict(points=cloud, T_map_sensor=pose, T_map_base=pose, dt=DT, cfg=CONFIG)
VECTOR = dict(points=clouds, T_map_sensor=poses, T_map_base=poses, dt=DT, cfg=CONFIG)


def grounds(mode, kind=SyncVectorEnv):
    return kind([lambda i=i, n=n: Ground(i, n) for i, n in enumerate(LENGTHS)], autoreset_mode=mode)


def expected_map(index, episode, count):
    """A new map, fed with the clouds of the episode so far."""
    emap = ElevationMap(CONFIG)
    for step in range(count + 1):
        T = torch.from_numpy(pose_of(step))[None]
        points = torch.from_numpy(cloud_of(index, episode, step))[None]
        emap.update(points, T, T, dt=DT if step else 0.0)
    return emap


def assert_map(wrapper, values, row, index, episode, count):
    """The map, and what is observed of it, are those of this episode's clouds, each fused once."""
    expected = expected_map(index, int(episode), int(count))
    for name in LAYERS:
        given, wanted = wrapper.emap.layer(name)[row], expected.layer(name)[0]
        torch.testing.assert_close(given, wanted, rtol=0, atol=1e-6, equal_nan=True, msg=lambda m, n=name: f"{n}: {m}")
    wanted = DEFAULT_READ(expected, torch.from_numpy(pose_of(count))[None])[0]
    torch.testing.assert_close(torch.as_tensor(values), wanted, rtol=0, atol=1e-6)
    assert 0.2 < wanted[1].mean() < 1  # some is known and some is not, or nothing is compared


def assert_maps(wrapper, observation):
    for i in range(wrapper.num_envs):
        assert_map(wrapper, observation["map"][i], i, i, *observation["observation"][i])


def test_single_environment():
    env = ElevationMapObservation(Ground(length=3), **SINGLE)
    for episode in (1, 2):
        observation, _ = env.reset()
        for count in range(4):
            assert observation["observation"].tolist() == [episode, count]
            assert observation in env.observation_space
            assert_map(env, observation["map"], 0, 0, episode, count)
            height, valid = observation["map"]
            np.testing.assert_allclose(height[valid == 1], 0.1 * episode - 1.0, atol=1e-6)  # below the base at 1 m
            assert (height[valid == 0] == 0).all()
            if count < 3:
                observation, _, terminated, _, _ = env.step(0)
        assert terminated


def test_reset_comes_before_the_next_step_s():
    env = ElevationMapObservation(Autoreset(Ground(length=3)), **SINGLE)
    for steps, episode in ((1, 1), (3, 2), (2, 3)):  # after the second, the next step would begin anew
        env.reset()
        for count in range(1, steps + 1):
            observation, *_ = env.step(0)
            assert_map(env, observation["map"], 0, 0, episode, count)


def test_steps_beyond_the_end_keep_the_map():
    env = ElevationMapObservation(Ground(length=1), **SINGLE)
    env.reset()
    for count in (1, 2, 3):
        observation, *_ = env.step(0)
        assert_map(env, observation["map"], 0, 0, 1, count)


@pytest.mark.parametrize("index", [0, 1])
def test_autoreset_wrapper_below(index):
    env = gymnasium.wrappers.TransformReward(Autoreset(Ground(index, length=2)), float)
    env = ElevationMapObservation(env, **SINGLE)
    env.reset()
    seen = []
    for _ in range(7):
        observation, *_ = env.step(0)
        seen.append(tuple(observation["observation"].astype(int)))
        assert_map(env, observation["map"], 0, index, *seen[-1])
    assert seen == [(1, 1), (1, 2), (2, 0), (2, 1), (2, 2), (3, 0), (3, 1)]


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_autoreset_of_vector_environments(mode):
    env = VectorElevationMapObservation(grounds(mode), **VECTOR)
    observation, _ = env.reset(seed=0)
    assert_maps(env, observation)
    episodes = []
    for _ in range(9):
        observation, _, _, _, _ = env.step(np.zeros(3, int))
        assert observation in env.observation_space
        assert_maps(env, observation)
        episodes.append(observation["observation"][:, 0].tolist())
    # By hand: an episode of n steps shows n + 1 observations where the reset takes a step, else n.
    taken = [n + 1 if mode is AutoresetMode.NEXT_STEP else n for n in LENGTHS]
    assert episodes == [[1 + t // n for n in taken] for t in range(1, 10)]


def test_final_observation_gets_the_map_before_it():
    env = VectorElevationMapObservation(grounds(AutoresetMode.SAME_STEP), **VECTOR)
    observation, _ = env.reset(seed=0)
    ends = 0
    for _ in range(6):
        before = observation["map"].copy()
        observation["map"][:] = np.nan  # the caller's own: nothing may depend on it
        observation, _, terminations, truncations, infos = env.step(np.zeros(3, int))
        ended = terminations | truncations
        for i in np.flatnonzero(ended):
            final = infos["final_obs"][i]
            assert final in env.single_observation_space
            assert final["observation"][1] == LENGTHS[i]
            np.testing.assert_array_equal(final["map"], before[i])
            ends += 1
        for i in np.flatnonzero(~ended) if ended.any() else ():
            assert infos["final_obs"][i] is None
    assert ends == 3 + 2 + 1


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_masked_reset_leaves_the_others_as_they_are(mode):
    env = VectorElevationMapObservation(grounds(mode), **VECTOR)
    env.reset(seed=0)
    env.step(np.zeros(3, int))
    options = {"reset_mask": np.array([False, True, False])}
    observation, _ = env.reset(options=options)
    assert list(options) == ["reset_mask"]
    assert observation["observation"].tolist() == [[1, 1], [2, 0], [1, 1]]
    assert_maps(env, observation)


def test_masked_reset_at_the_end_of_episodes():
    env = VectorElevationMapObservation(grounds(AutoresetMode.DISABLED), **VECTOR)
    env.reset(seed=0)
    resets = 0
    for _ in range(7):
        observation, _, terminations, truncations, _ = env.step(np.zeros(3, int))
        assert_maps(env, observation)
        ended = terminations | truncations
        if ended.any():
            resets += ended.sum()
            observation, _ = env.reset(options={"reset_mask": ended})
            assert_maps(env, observation)
    assert resets == 3 + 2 + 1


def test_masked_reset_at_the_end_comes_before_the_next_step_s():
    env = VectorElevationMapObservation(grounds(AutoresetMode.NEXT_STEP), **VECTOR)
    env.reset(seed=0)
    for _ in range(2):
        *_, terminations, _, _ = env.step(np.zeros(3, int))
    assert terminations.tolist() == [True, False, False]
    env.reset(options={"reset_mask": terminations})
    observation, *_ = env.step(np.zeros(3, int))
    assert observation["observation"].tolist() == [[2, 1], [1, 3], [1, 3]]
    assert_maps(env, observation)


def test_processes():
    env = VectorElevationMapObservation(grounds(AutoresetMode.NEXT_STEP, AsyncVectorEnv), **VECTOR)
    try:
        env.reset(seed=0)
        for _ in range(3):
            observation, *_ = env.step(np.zeros(3, int))
        assert observation["observation"].tolist() == [[2, 0], [1, 3], [1, 3]]
        assert_maps(env, observation)
    finally:
        env.close()


def test_make_vec_with_single_wrappers():
    wrapped = [lambda i=i: ElevationMapObservation(Ground(i, 2), **SINGLE) for i in range(2)]
    env = SyncVectorEnv(wrapped)
    env.reset(seed=0)
    for count in (1, 2, 0):
        observation, *_ = env.step(np.zeros(2, int))
        for i, single in enumerate(env.envs):
            assert_map(single, observation["map"][i], 0, i, 2 if count == 0 else 1, count)


class TorchGrounds(VectorEnv):
    """Vector environments in tensors, with a Dict observation and a batched final one."""

    num_envs = 3
    single_observation_space = spaces.Dict(state=spaces.Box(0, 100, (2,), np.float32))
    observation_space = spaces.Dict(state=spaces.Box(0, 100, (3, 2), np.float32))
    single_action_space, action_space = spaces.Discrete(2), spaces.MultiDiscrete([2, 2, 2])

    def __init__(self, mode=AutoresetMode.SAME_STEP):
        self.metadata = {"autoreset_mode": mode, "torch": True}

    def reset(self, *, seed=None, options=None):
        self.state = torch.tensor([[1.0, 0.0]]).repeat(3, 1)
        return {"state": self.state.clone()}, {}

    def step(self, actions):
        final = self.state + torch.tensor([0.0, 1.0])
        ended = final[:, 1] >= torch.tensor(LENGTHS)
        begins = ended & (self.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP)
        self.state = torch.where(begins[:, None], torch.stack([final[:, 0] + 1, torch.zeros(3)], 1), final)
        infos = {"final_obs": {"state": final}, "_final_obs": ended}
        return {"state": self.state.clone()}, torch.zeros(3), ended, torch.zeros_like(ended), infos


def torch_clouds(envs):
    rows = [cloud_of(i, *envs.state[i].int().tolist()) for i in range(3)]
    return torch.from_numpy(np.stack(rows))


def torch_poses(envs):
    return torch.from_numpy(np.stack([pose_of(int(count)) for count in envs.state[:, 1]]))


TORCH = dict(points=torch_clouds, T_map_sensor=torch_poses, T_map_base=torch_poses, dt=DT, cfg=CONFIG)


def test_torch_vector_environment():
    env = VectorElevationMapObservation(TorchGrounds(), **TORCH)
    assert list(env.single_observation_space) == ["map", "state"]
    with torch.inference_mode():  # where reinforcement-learning libraries step
        observation, _ = env.reset()
        for _ in range(3):
            before = observation["map"].clone()
            observation, _, ended, _, infos = env.step(torch.zeros(3))
    assert ended.tolist() == [False, True, False]
    assert isinstance(observation["map"], torch.Tensor) and observation["map"].dtype == torch.float32
    for i in range(3):
        assert_map(env, observation["map"][i], i, i, *observation["state"][i].int().tolist())
    assert infos["final_obs"]["state"].tolist() == [[2, 1], [1, 3], [1, 3]]
    assert torch.equal(infos["final_obs"]["map"], before)
    observation, _ = env.reset()
    assert_map(env, observation["map"][2], 2, 2, 1, 0)


def test_disabled_autoreset_forgets_nothing_by_itself():
    env = VectorElevationMapObservation(TorchGrounds(AutoresetMode.DISABLED), **TORCH)
    env.reset()
    for _ in range(4):
        observation, _, ended, _, _ = env.step(torch.zeros(3))
    assert ended.tolist() == [True, True, False]
    for i in range(3):
        assert_map(env, observation["map"][i], i, i, 1, 4)


class MetaGrounds(TorchGrounds):
    """On a device whose tensors have no values, so that reading one back raises."""

    def reset(self, *, seed=None, options=None):
        return {"state": torch.empty(3, 2, device="meta")}, {}

    def step(self, actions):
        flags = torch.empty(3, dtype=torch.bool, device="meta")
        state = {"state": torch.empty(3, 2, device="meta")}
        return state, torch.empty(3, device="meta"), flags, flags, {"final_obs": state}


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_host_reads_nothing_back(mode):
    sources = dict(points=lambda envs: torch.empty(3, 50, 3, device="meta"), dt=DT, cfg=CONFIG, device="meta")
    poses = dict.fromkeys(("T_map_sensor", "T_map_base"), lambda envs: torch.empty(3, 4, 4, device="meta"))
    env = VectorElevationMapObservation(MetaGrounds(mode), **sources, **poses)
    with OneDevice():
        env.reset()
        env.reset(options={"reset_mask": torch.empty(3, dtype=torch.bool, device="meta")})
        observation, *_ = env.step(None)
    assert observation["map"].device.type == "meta"


def test_converted_environment_gives_tensors():
    env = ElevationMapObservation(gymnasium.wrappers.NumpyToTorch(Ground()), **SINGLE)
    observation, _ = env.reset(seed=0)
    assert isinstance(observation["observation"], torch.Tensor)
    assert isinstance(observation["map"], torch.Tensor)


def test_observations_are_the_caller_s_own():
    env = ElevationMapObservation(Ground(), **SINGLE, read=lambda emap, T: emap.elevation)
    first, _ = env.reset(seed=0)
    kept = first["map"].copy()
    second, *_ = env.step(0)
    assert not np.array_equal(second["map"], kept)
    np.testing.assert_array_equal(first["map"], kept)
    before = env.emap.layer("elevation")
    second["map"][:] = 7
    torch.testing.assert_close(env.emap.layer("elevation"), before, equal_nan=True)


def test_what_is_not_finite_is_read_as_zero():
    env = ElevationMapObservation(Ground(), **SINGLE, read=lambda emap, T: emap.layer("elevation") / 0)
    assert env.observation_space["map"].shape == (24, 24)
    observation, _ = env.reset(seed=0)
    assert (observation["map"] == 0).all()


def test_values_and_validity_are_stacked():
    def scan(emap, T_map_base):
        assert not torch.is_grad_enabled()
        return emap.sample(T_map_base[:, None, :2, 3] + torch.tensor([[0.0, 0.0], [0.1, 0.2], [9.0, 9.0]]))

    env = ElevationMapObservation(Ground(), **SINGLE, read=scan)
    observation, _ = env.reset(seed=0)
    assert observation["map"].shape == (2, 3) and observation["map"].dtype == np.float32
    np.testing.assert_allclose(observation["map"], [[0.1, 0.1, 0.0], [1, 1, 0]], atol=1e-6)


def test_validity_follows_the_rows_of_a_scan_with_channels():
    cfg = dataclasses.replace(CONFIG, channels={"rgb": "color"})
    scan = HeightScan.isaac_lab(channels=("rgb",), channel_fill=0.5)
    env = VectorElevationMapObservation(grounds(AutoresetMode.NEXT_STEP), **(VECTOR | {"cfg": cfg}), read=scan)
    observation, _ = env.reset(seed=0)
    values, valid = scan(env.emap, torch.from_numpy(poses(env.env)))
    assert observation["map"].shape == (3, 8, 187) and valid[:, 0].any() and (values[:, 1:] == 0.5).all()
    np.testing.assert_array_equal(observation["map"], torch.cat([values, valid.float()], 1))


@pytest.mark.parametrize("scan", [HeightScan.isaac_lab(), MapImage(length_x=1.0, length_y=0.8)])
def test_height_scans_and_images_of_the_map(scan):
    env = VectorElevationMapObservation(grounds(AutoresetMode.NEXT_STEP), **VECTOR, read=scan)
    observation, _ = env.reset(seed=0)
    shape = scan.shape if isinstance(scan, MapImage) else (2, scan.num_points)
    assert observation["map"].shape == (3, *shape) and observation in env.observation_space
    values = scan(env.emap, torch.from_numpy(poses(env.env)))
    wanted = values if isinstance(scan, MapImage) else torch.stack([values[0], values[1].float()], 1)
    np.testing.assert_array_equal(observation["map"], wanted)


def depth_image(env):
    image = np.full((4, 6), 2.0, np.float32)
    image[0, 0] = 0.0  # no return
    return image


def looks_down(env):
    """An optical frame: x right, y down the image, z forward, which is down."""
    return np.array([[0.0, -1, 0, 0.25], [-1, 0, 0, 0.15], [0, 0, -1, 2.5], [0, 0, 0, 1]])


def test_depth_images():
    intrinsics = [[10, 0, 2.5], [0, 10, 1.5], [0, 0, 1]]
    sources = dict(depth=depth_image, intrinsics=intrinsics, T_map_sensor=looks_down, T_map_base=pose)
    env = ElevationMapObservation(Ground(), **sources, dt=DT, cfg=CONFIG)
    env.reset(seed=0)
    seen = np.zeros((24, 24), bool)
    for v in range(4):
        for u in range(6):
            if (v, u) != (0, 0):  # pixels are 0.2 m apart on the ground; image right is -y, image down is -x
                x, y = 0.25 - (v - 1.5) * 0.2, 0.15 - (u - 2.5) * 0.2
                seen[int(np.floor(x / 0.1 + 12)), int(np.floor(y / 0.1 + 12))] = True
    elevation = env.emap.layer("elevation")[0]
    assert seen.sum() == 23
    assert torch.equal(elevation.isfinite(), torch.from_numpy(seen))
    torch.testing.assert_close(elevation[torch.from_numpy(seen)], torch.full((23,), 0.5))


def test_arrays_of_any_strides():
    env = ElevationMapObservation(Ground(), **{**SINGLE, "points": lambda env: cloud(env)[::-1]})
    observation, _ = env.reset(seed=0)
    assert_map(env, observation["map"], 0, 0, 1, 0)


def test_several_sensors():
    both = dict(points=lambda env: np.stack([cloud(env), cloud(env) + [0, 0.3, 0]]))
    both["T_map_sensor"] = lambda env: np.stack([pose(env)] * 2)
    env = ElevationMapObservation(Ground(), **{**SINGLE, **both})
    env.reset(seed=0)
    known = env.emap.layer("validity").sum()
    env = ElevationMapObservation(Ground(), **SINGLE)
    env.reset(seed=0)
    assert known > env.emap.layer("validity").sum()


gymnasium.register("torchelev-test/Ground-v0", Ground)


@pytest.mark.filterwarnings("ignore")
def test_gymnasium_s_checks():
    env = gymnasium.make("torchelev-test/Ground-v0")
    check_env(ElevationMapObservation(env, **SINGLE))


def test_spec_makes_the_same():
    env = ElevationMapObservation(gymnasium.make("torchelev-test/Ground-v0"), **SINGLE, key="terrain")
    again = gymnasium.make(env.spec)
    assert isinstance(again, ElevationMapObservation) and again.emap.cfg == CONFIG
    assert again.observation_space == env.observation_space


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_go_on_alone(copied):
    env = ElevationMapObservation(Ground(), **SINGLE)
    env.reset(seed=0)
    env.step(0)
    twin = copied(env)
    for _ in range(2):
        env.step(0)
    observation, *_ = twin.step(0)
    assert_map(twin, observation["map"], 0, 0, 1, 2)


def test_the_wrapper_is_transparent():
    ground = Ground()
    env = ElevationMapObservation(ground, **SINGLE)
    assert env.unwrapped is ground and env.action_space == ground.action_space
    assert gymnasium.wrappers.TimeLimit(env, 5).get_wrapper_attr("emap") is env.emap
    other = ElevationMapObservation(Ground(), **SINGLE)
    env.reset(seed=0)
    other.emap.load_state_dict(env.emap.state_dict())
    assert torch.equal(other.emap.elevation, env.emap.elevation)
    env.close()
    env.close()


BAD = {
    "T_map_base: must be a function": dict(T_map_base=None),
    "T_map_sensor: must be a function": dict(T_map_sensor=np.eye(4)),
    "neither; give env": dict(points=None),
    "points and depth; give env": dict(depth=depth_image, intrinsics=np.eye(3)),
    "intrinsics: must be given with depth": dict(points=None, depth=depth_image),
    "intrinsics: must be given with depth, and only then": dict(intrinsics=np.eye(3)),
    "dt: must be seconds, got None; give": dict(dt=None),
    "dt: must be seconds, got -1": dict(dt=-1),
    "read: must return a tensor .1, \\.+., got .3,.": dict(read=lambda emap, T: torch.zeros(3)),
    "read: must return a tensor .1, \\.+., got ndarray": dict(read=lambda emap, T: np.zeros(3)),
    "key: must be a new key, got 'observation'; there are observation": dict(key="observation"),
}


@pytest.mark.parametrize("message", BAD)
def test_refuses_bad_arguments(message):
    with pytest.raises(ValueError, match=message):
        ElevationMapObservation(Ground(), **{**SINGLE, **BAD[message]})


LATE = {
    "points: must return .N, 3., got .300,.": dict(points=lambda env: cloud(env)[:, 0]),
    r"keep x, y and z alone": dict(points=lambda env: np.zeros((5, 4))),
    "points: must return floating-point numbers, got torch.int64": dict(points=lambda env: np.zeros((5, 3), int)),
    "T_map_base: must be finite, got NaN": dict(T_map_base=lambda env: pose(env) * np.nan),
    "T_map_sensor: must be rigid": dict(T_map_sensor=lambda env: pose(env) * 2),
    "T_map_base: expected .1, 4, 4. on cpu, got .1, 3, 3.": dict(T_map_base=lambda env: np.eye(3)),
}


@pytest.mark.parametrize("message", LATE)
def test_refuses_what_functions_return(message):
    env = ElevationMapObservation(Ground(), **{**SINGLE, **LATE[message]})
    with pytest.raises((ValueError, TypeError), match=message):
        env.reset(seed=0)


VECTOR_LATE = {
    "points: must return .3, N, 3., got .2, 300, 3.; give one for each": dict(points=lambda envs: clouds(envs)[:2]),
    "points: must be of one shape, got .299, 3. and .300, 3.; pad": dict(
        points=lambda envs: [one[i == 1 :] for i, one in enumerate(clouds(envs))]
    ),
    "T_map_base: must return .3, 4, 4., got .4, 4.": dict(T_map_base=lambda envs: pose_of(0)),
}


@pytest.mark.parametrize("message", VECTOR_LATE)
def test_refuses_what_vector_functions_return(message):
    env = VectorElevationMapObservation(grounds("NextStep"), **{**VECTOR, **VECTOR_LATE[message]})
    with pytest.raises(ValueError, match=message):
        env.reset(seed=0)


def test_refuses_the_other_kind_of_environment():
    with pytest.raises(TypeError, match="use VectorElevationMapObservation"):
        ElevationMapObservation(grounds("NextStep"), **VECTOR)
    with pytest.raises(TypeError, match="use ElevationMapObservation for a single Env"):
        VectorElevationMapObservation(Ground(), **SINGLE)


def test_refuses_an_unknown_autoreset_mode():
    env = grounds("NextStep")
    env.metadata = {}
    with pytest.raises(ValueError, match="must be an AutoresetMode, got none; set NEXT_STEP or SAME_STEP or DISABLED"):
        VectorElevationMapObservation(env, **VECTOR)


# MuJoCo ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def example():
    """The names of the module's example, after it ran as its docstring says."""
    pytest.importorskip("mujoco")
    pytest.importorskip("imageio")  # which gymnasium's MuJoCo environments import
    (test,) = doctest.DocTestFinder(recurse=False).find(torchelev.gym.wrappers)
    result = doctest.DocTestRunner().run(test, clear_globs=False)
    assert result.attempted > 10 and result.failed == 0
    return test.globs


def test_ant_maps_the_floor_and_a_box(example, tmp_path):
    from gymnasium.envs.mujoco.mujoco_env import expand_model_path

    with open(expand_model_path("ant.xml")) as file:
        box = '<geom name="block" type="box" pos="1.2 0.2 0.1" size="0.3 0.4 0.1" conaffinity="1"/>'
        xml = file.read().replace("</worldbody>", box + "</worldbody>")
    (tmp_path / "ant_and_box.xml").write_text(xml)
    ant = gymnasium.make("Ant-v5", xml_file=str(tmp_path / "ant_and_box.xml"))
    cfg = ElevationMapConfig(grid=GridConfig(resolution=0.1, length_x=4.0, length_y=4.0))
    functions = {name: example[name] for name in ("points", "T_map_sensor", "T_map_base")}
    env = ElevationMapObservation(ant, **functions, dt=ant.unwrapped.dt, cfg=cfg)
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(20):
        observation, *_ = env.step(env.action_space.sample())
        assert np.isfinite(observation["map"]).all()
    elevation, cells = env.emap.layer("elevation")[0], env.emap.cell_centers()[0]
    beyond = ((cells - torch.tensor([1.2, 0.2])).abs() - torch.tensor([0.3, 0.4])).amax(-1)  # of the box's sides [m]
    floor, top = elevation[beyond > 0.15], elevation[beyond < -0.05]
    assert floor.isfinite().sum() > 150 and top.isfinite().sum() > 15
    assert floor[floor.isfinite()].abs().max() < 1e-3
    assert (top[top.isfinite()] - 0.2).abs().max() < 1e-3
