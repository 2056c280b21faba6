"""Add an elevation map to the observations of any gymnasium environment, single or vector, NumPy or torch.

You give functions that return the environment's points (or depth images) and poses. The wrapper fuses one cloud per
reset and step, and adds what `read` returns to the observation. MuJoCo's Ant with a depth camera on its torso:

>>> import gymnasium, mujoco
>>> import numpy as np
>>> from torchelev.gym import ElevationMapObservation
>>> from torchelev import ElevationMapConfig, GridConfig
>>> from torchelev.sim import DepthCamera, mount
>>> rays = DepthCamera(width=32, height=24).directions.numpy()
>>> def T_map_base(env):
...     torso, T = env.unwrapped.data.body("torso"), np.eye(4)
...     T[:3, :3], T[:3, 3] = torso.xmat.reshape(3, 3), torso.xpos
...     return T
>>> def T_map_sensor(env):
...     return T_map_base(env) @ mount(pitch_deg=40).numpy()
>>> def points(env):
...     model, data, T = env.unwrapped.model, env.unwrapped.data, T_map_sensor(env)
...     geom, distance = np.zeros(len(rays), np.int32), np.zeros(len(rays))
...     world, torso = (rays @ T[:3, :3].T).ravel(), model.body("torso").id
...     mujoco.mj_multiRay(model, data, T[:3, 3], world, None, 1, torso, geom, distance, None, len(rays), 8.0)
...     nothing_or_a_leg = (geom < 0) | (distance > 8.0) | (model.geom_bodyid[geom] != 0)
...     return np.where(nothing_or_a_leg, np.nan, distance)[:, None] * rays
>>> ant = gymnasium.make("Ant-v5")
>>> env = ElevationMapObservation(
...     ant, points=points, T_map_sensor=T_map_sensor, T_map_base=T_map_base, dt=ant.unwrapped.dt,
...     cfg=ElevationMapConfig(grid=GridConfig(resolution=0.1, length_x=4.0, length_y=4.0)))
>>> observation, info = env.reset(seed=0)
>>> {name: value.shape for name, value in observation.items()}
{'observation': (105,), 'map': (2, 16, 10)}
>>> observation, *_ = env.step(env.action_space.sample())
>>> elevation = env.emap.layer("elevation")[0]  # the floor at 0, NaN where the camera has not looked
>>> bool(elevation.nan_to_num().abs().max() < 1e-3)
True
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig
from torchelev.errors import require
from torchelev.gym.feed import MapFeed, Source, as_tensor


class _MapObservation(RecordConstructorArgs):
    """Base of both wrappers: their arguments, and how they extend spaces and observations."""

    _env_type: type  # of the environments that can be wrapped
    _wrapper_type: type  # gymnasium's wrapper of that type
    _hint: str  # for environments of another type

    def __init__(
        self,
        env: Any,
        *,
        points: Source | None = None,
        depth: Source | None = None,
        intrinsics: Any = None,
        T_map_sensor: Source | None = None,
        T_map_base: Source | None = None,
        T_base_links: Source | None = None,
        dt: float | None = None,
        read: Callable[[ElevationMap, Tensor], Any] | None = None,
        cfg: ElevationMapConfig | None = None,
        device: torch.device | str = "cpu",
        key: str = "map",
    ) -> None:
        rule = f"must be a {self._env_type.__name__}"
        require(isinstance(env, self._env_type), "env", rule, type(env).__name__, self._hint, TypeError)
        sources = {"points": points, "depth": depth, "intrinsics": intrinsics}
        poses = {"T_map_sensor": T_map_sensor, "T_map_base": T_map_base, "T_base_links": T_base_links, "dt": dt}
        maps = {"read": read, "cfg": cfg, "device": device}
        # Not copied: a function may be a method of a large object, such as the simulation.
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, **sources, **poses, **maps, key=key)
        self._wrapper_type.__init__(self, env)  # type: ignore[misc]
        num_envs = env.num_envs if isinstance(env, VectorEnv) else None
        self._key, self._feed = key, MapFeed(num_envs, **sources, **poses, **maps)  # type: ignore[arg-type]
        self._ended = torch.zeros(self.emap.num_envs, dtype=torch.bool, device=self.emap.device)
        self._last = self._feed.read_blank()
        self._extend_spaces(spaces.Box(-np.inf, np.inf, tuple(self._last.shape[1:]), np.float32))

    @property
    def emap(self) -> ElevationMap:
        """The maps, for instance to read layers, to save them or to compile their updates."""
        return self._feed.emap

    def _extend_spaces(self, box: spaces.Box) -> None:
        raise NotImplementedError

    def _extend(self, space: spaces.Space, box: spaces.Space) -> spaces.Dict:
        parts = dict(space.spaces) if isinstance(space, spaces.Dict) else {"observation": space}
        require(self._key not in parts, "key", "must be a new key", repr(self._key), f"there are {', '.join(parts)}")
        return spaces.Dict({**parts, self._key: box})

    def _add_map(self, observation: Any, values: Tensor) -> dict[str, Any]:
        """Add the map's values to an observation, as the kind of array that the observation holds."""
        leaf = observation
        while isinstance(leaf, dict | tuple):
            leaf = next(iter(leaf.values() if isinstance(leaf, dict) else leaf), None)
        array = values.to(leaf.device) if isinstance(leaf, Tensor) else values.cpu().numpy()
        return {**(observation if isinstance(observation, dict) else {"observation": observation}), self._key: array}


class ElevationMapObservation(_MapObservation, gymnasium.Wrapper):
    """Add the elevation map to the observation of a single environment.

    The observation becomes a Dict that holds the map under `key`. A Dict observation keeps its own keys; any other one
    is found under "observation". `reset` resets the map, and so does a step in which a `gymnasium.wrappers.Autoreset`
    inside this wrapper resets the environment.

    Args:
        env: the environment to wrap. The functions below get it as their argument.
        points: env -> (N, 3) or (S, N, 3) [m], sensor frame; NaN points are ignored.
        depth: env -> (h, w) or (S, h, w) [m] along the optical axis, instead of `points`.
        intrinsics: (3, 3) [pixels], required with `depth`. The sensor frame is then x right, y down, z forward.
        T_map_sensor: env -> (4, 4) or (S, 4, 4), sensor frame to map frame.
        T_map_base: env -> (4, 4), base frame to map frame; the map's window follows the base.
        T_base_links: env -> (K, 4, 4), poses of the links; required if `cfg.sensor.body` is a RobotBody.
        dt: duration of one step [s].
        read: (emap, T_map_base) -> (B, ...), such as a `torchelev.MapImage`; or values and validity, such as a
            `HeightScan`, which are stacked to (B, 2, ...); those of a scan with channels follow each other,
            (B, 2 (1 + C), P). Here B = 1. Values that are not finite become 0. None: the elevation relative to the base
            and its validity, every 0.1 m of 1.6 x 1.0 m around the base.
        cfg: config of the map.
        device: device of the map.
        key: key of the map in the observation.

    Raises:
        ValueError, TypeError: for a missing argument or a wrong value.
    """

    _env_type, _wrapper_type = gymnasium.Env, gymnasium.Wrapper
    _hint = "use VectorElevationMapObservation for a VectorEnv"

    def _extend_spaces(self, box: spaces.Box) -> None:
        self.observation_space = self._extend(self.env.observation_space, box)
        self._autoreset = _has_autoreset(self.env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and its map."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._ended = torch.zeros_like(self._ended)
        values = self._feed.observe(self.env, torch.ones_like(self._ended), stepped=False)[0]
        return self._add_map(observation, values), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment and fuse its cloud."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        began, self._ended = self._ended, torch.full_like(self._ended, self._autoreset and (terminated or truncated))
        values = self._feed.observe(self.env, began, stepped=True)[0]
        return self._add_map(observation, values), reward, terminated, truncated, info


class VectorElevationMapObservation(_MapObservation, VectorWrapper):
    """Add the elevation map to the observations of a vector environment.

    Arguments and errors are those of `ElevationMapObservation`, for B environments: each function returns an array with
    a leading dimension B, or a list or tuple of B arrays, as `env.call` does.

    The map of an environment is reset exactly when its episode starts. By `metadata["autoreset_mode"]`:

    - NEXT_STEP: in the step after the last one of an episode.
    - SAME_STEP: in the last step itself. `infos["final_obs"]` then holds the map of the step before, as the environment
      has already replaced its final cloud when the step returns.
    - DISABLED: by `reset` alone.

    In every mode `reset(options={"reset_mask": ...})` resets the masked environments and leaves the other maps as they
    are.
    """

    _env_type, _wrapper_type = VectorEnv, VectorWrapper
    _hint = "use ElevationMapObservation for a single Env"

    def _extend_spaces(self, box: spaces.Box) -> None:
        hint = f"set {' or '.join(mode.name for mode in AutoresetMode)}"
        actual = self.env.metadata.get("autoreset_mode", "none")
        is_known = actual in AutoresetMode.__members__.values()
        require(is_known, 'env.metadata["autoreset_mode"]', "must be an AutoresetMode", actual, hint)
        self._mode = actual
        self.single_observation_space = self._extend(self.env.single_observation_space, box)
        self.observation_space = self._extend(self.env.observation_space, batch_space(box, self.num_envs))

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset all environments, or those of `options["reset_mask"]`, and their maps."""
        mask = None if options is None else options.get("reset_mask")
        began = torch.ones_like(self._ended) if mask is None else self._flags(mask)
        # A copy: environments remove the mask from their options.
        observations, infos = self.env.reset(seed=seed, options=None if options is None else dict(options))
        self._ended = self._ended & ~began
        return self._observe(observations, began, stepped=False), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the environments, reset the maps of new episodes, and fuse one cloud into each map."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        ended = self._flags(terminations) | self._flags(truncations)
        if self._mode is AutoresetMode.SAME_STEP and "final_obs" in infos:
            infos = {**infos, "final_obs": self._add_map_to_final(infos["final_obs"])}
        began = {
            AutoresetMode.NEXT_STEP: self._ended,
            AutoresetMode.SAME_STEP: ended,
            AutoresetMode.DISABLED: torch.zeros_like(ended),
        }[self._mode]
        self._ended = ended
        return self._observe(observations, began, stepped=True), rewards, terminations, truncations, infos

    def _flags(self, value: Any) -> Tensor:
        return as_tensor("flags", value, self.emap.device).bool()

    def _observe(self, observations: Any, began: Tensor, stepped: bool) -> dict[str, Any]:
        values = self._feed.observe(self.env, began, stepped)
        if self._mode is AutoresetMode.SAME_STEP:
            self._last = values.clone()  # the caller may change the observation
        return self._add_map(observations, values)

    def _add_map_to_final(self, observations: Any) -> Any:
        """Add the last map to the final observations: an array of objects with None, or a batch."""
        if not (isinstance(observations, np.ndarray) and observations.dtype == object):
            return self._add_map(observations, self._last)
        result = np.full_like(observations, None)
        for i, observation in enumerate(observations):
            if observation is not None:
                result[i] = self._add_map(observation, self._last[i])
        return result


def _has_autoreset(env: Any) -> bool:
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, gymnasium.wrappers.Autoreset):
            return True
        env = env.env
    return False
