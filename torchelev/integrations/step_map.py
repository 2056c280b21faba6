"""Maps that follow the control steps of a manager-based environment: one update per step, and resets with its episodes.

Simulators differ only in where their data are: `Source` is the interface to them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig
from torchelev.errors import require_count
from torchelev.frames.arrays import assemble

if TYPE_CHECKING:
    from jaxtyping import Float


class Cloud(NamedTuple):
    """The points of the S sensors of each environment at one instant."""

    points: Float[Tensor, "B S N 3"]  #: [m] sensor frame; NaN where a ray hit nothing
    T_map_sensor: Float[Tensor, "B S 4 4"]  #: sensor frame to map frame


class Source(Protocol):
    """Where a simulator keeps the data of its sensors and of the robot. Equal sources read the same data."""

    def read_cloud(self, env: Any) -> Cloud:
        """Return the latest cloud of each environment."""

    def read_base(self, env: Any) -> Float[Tensor, "B 4 4"]:
        """Return T_map_base, the pose of each robot's base."""

    def read_feet(self, env: Any) -> Float[Tensor, "B K 3"]:
        """Return the positions of the feet [m], map frame; only asked for by a scan around feet."""


class StepMap:
    """The maps of an environment's B robots.

    An update takes place in the first observation of every `update_every`-th control step, counted by the environment's
    `common_step_counter`; later observations of the step read the same maps. An environment that restarts within a
    step that is already fused is fused alone, and the other maps stay as they are. One that begins between two updates
    reads an empty map until the next.

    Args:
        env: the manager-based environment: `num_envs`, `device`, `step_dt` [s] and `common_step_counter`.
        source: where the clouds and base poses come from.
        cfg: config of the map.
        update_every: control steps from one update to the next.
    """

    def __init__(self, env: Any, source: Source, cfg: ElevationMapConfig, update_every: int = 1) -> None:
        self.source = source
        self.update_every = require_cadence(update_every)
        self.is_empty = True  # nothing was fused yet
        self._step = env.common_step_counter  # of the last update
        self._has_begun = False  # whether an environment began since then: reading `_began` would wait for the device
        with torch.inference_mode(False):  # else buffers could not be written outside of inference mode
            self.emap = ElevationMap(cfg, num_envs=env.num_envs, device=env.device)
            self._began = torch.ones(env.num_envs, dtype=torch.bool, device=self.emap.device)

    @torch.no_grad()
    def reset(self, env_ids: Any = None) -> None:
        """Forget the maps of environments that restart: ids, a mask (B,) bool, a slice, or None for all."""
        self._has_begun = True
        if env_ids is None or isinstance(env_ids, slice):
            mask = torch.zeros_like(self._began)
            mask[slice(None) if env_ids is None else env_ids] = True
        else:
            chosen = torch.as_tensor(env_ids, device=self.emap.device)
            if chosen.dtype != torch.bool:
                ids = chosen.to(torch.int64)  # an empty list has floats
                self.emap.reset(ids)
                self._began.index_fill_(0, ids, True)
                return
            mask = chosen
        self.emap.reset(mask=mask)
        self._began |= mask

    @torch.no_grad()
    def advance(self, env: Any) -> None:
        """Fuse the latest cloud into the maps that are due."""
        steps = env.common_step_counter - self._step
        if not 0 <= steps < self.update_every:  # a resumed training sets the counter, also to a lower number
            self._fuse(env, only_new=False, elapsed=steps if steps > 0 else self.update_every)
        elif self._has_begun and steps == 0:
            self._fuse(env, only_new=True, elapsed=0)

    def _fuse(self, env: Any, only_new: bool, elapsed: int) -> None:
        points, T_map_sensor = self.source.read_cloud(env)
        if only_new:
            points = torch.where(self._began[:, None, None, None], points, torch.nan)
        dt = torch.where(self._began, 0.0, elapsed * env.step_dt)
        self.emap.update(points, T_map_sensor, self.source.read_base(env), dt=dt)
        self._began.zero_()
        self._step, self._has_begun, self.is_empty = env.common_step_counter, False, False


def require_cadence(update_every: object) -> int:
    """Return the number of control steps between updates; ValueError unless it is a positive int."""
    return require_count("update_every", update_every, "give a number of control steps")


_SHARED: WeakKeyDictionary[Any, list[tuple[Any, StepMap]]] = WeakKeyDictionary()


def share_map(env: Any, source: Source, cfg: ElevationMapConfig, update_every: int) -> StepMap:
    """Return the maps of an environment with these settings: terms that agree on them share one update per step."""
    maps, settings = _SHARED.setdefault(env, []), (source, cfg, update_every)
    found = next((shared for known, shared in maps if known == settings), None)
    if found is None:
        found = StepMap(env, source, cfg, update_every)
        maps.append((settings, found))
    return found


def to_cloud(hits: Float[Tensor, "B S N 3"], origin: Float[Tensor, "B S 3"], missed: Tensor | None = None) -> Cloud:
    """Return the cloud of rays that start at one origin per sensor.

    The sensor frame is the map's axes at the origin, so that no rotation rounds the hits.

    Args:
        hits: where the rays end [m], map frame; values that are not finite are misses.
        origin: where they start [m], map frame.
        missed: (B, S, N) bool, further misses.
    """
    points = hits - origin[:, :, None]
    if missed is not None:
        points = torch.where(missed[..., None], torch.nan, points)
    axes = torch.eye(3, dtype=origin.dtype, device=origin.device).expand(*origin.shape[:2], 3, 3)
    return Cloud(points, assemble(origin, axes))


def join(clouds: list[Cloud]) -> Cloud:
    """Return the clouds of several sensors as one, the smaller ones padded with NaN points."""
    max_points = max(cloud.points.shape[2] for cloud in clouds)
    padded = [
        torch.nn.functional.pad(cloud.points, (0, 0, 0, max_points - cloud.points.shape[2]), value=torch.nan)
        for cloud in clouds
    ]
    return Cloud(torch.cat(padded, 1), torch.cat([cloud.T_map_sensor for cloud in clouds], 1))
