"""Maps that are fed from a simulator and read through functions of its environment."""

from __future__ import annotations

import math
from collections.abc import Callable
from numbers import Real
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig, MapImage, depth_to_points
from torchelev.errors import require

Source = Callable[[Any], Any]
DEFAULT_READ = MapImage(length_x=1.6, length_y=1.0, resolution=0.1, layers=("elevation", "validity"))
SHAPES = {"points": "N, 3", "depth": "h, w", "T_map_sensor": "4, 4", "T_map_base": "4, 4"}  # of one environment


class MapFeed:
    """The maps of B environments of any simulator, which fuse one cloud per reset and step.

    Each function gets the environment that `observe` is called with, and returns arrays or tensors with a leading B, or
    without it if `num_envs` is None.

    Args:
        num_envs: B, or None for a single environment.
        points: env -> (B, N, 3) or (B, S, N, 3) [m], sensor frame; NaN points are ignored.
        depth: env -> (B, h, w) or (B, S, h, w) [m] along the optical axis, in place of `points`.
        intrinsics: (3, 3) [pixels], with `depth`. The sensor frame is then x right, y down, z forward.
        T_map_sensor: env -> (B, 4, 4) or (B, S, 4, 4), sensor frame to map frame.
        T_map_base: env -> (B, 4, 4), the robot, which the map's window follows.
        dt: time of one step [s].
        read: (emap, T_map_base (B, 4, 4)) -> (B, ...), or values and validity, which are stacked to (B, 2, ...). None:
            elevation less the base's z, and validity, every 0.1 m of 1.6 x 1.0 m around the base.
        cfg: of the map.
        device: of the map.

    Raises:
        ValueError, TypeError: for what is missing or does not fit.
    """

    def __init__(
        self,
        num_envs: int | None,
        *,
        T_map_sensor: Source | None,
        T_map_base: Source | None,
        dt: float | None,
        points: Source | None = None,
        depth: Source | None = None,
        intrinsics: Any = None,
        read: Callable[[ElevationMap, Tensor], Any] | None = None,
        cfg: ElevationMapConfig | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        sources = {"points": points, "depth": depth, "T_map_sensor": T_map_sensor, "T_map_base": T_map_base}
        _check(sources, intrinsics, dt)
        self.sources: dict[str, Any] = sources
        self.batch = () if num_envs is None else (num_envs,)
        self.dt = float(dt)  # type: ignore[arg-type]
        self.reader = DEFAULT_READ if read is None else read
        self.emap = ElevationMap(cfg, num_envs=1 if num_envs is None else num_envs, device=device)
        self.device = self.emap.device
        self.intrinsics = None if intrinsics is None else as_tensor("intrinsics", intrinsics, self.device).double()

    def observe(self, env: Any, began: Tensor, stepped: bool) -> Tensor:
        """Forget the maps of new episodes, fuse one cloud into each map, and read them.

        Args:
            env: what the functions get.
            began: (B,) bool, where an episode began.
            stepped: after a step; False after a reset of those that `began`: the others have not moved, their cloud
                is fused already, and no time has passed.

        Returns:
            What `read` gives, float32 (B, ...).
        """
        T_map_base, T_map_sensor, points = self._ask("T_map_base", env), self._ask("T_map_sensor", env), self._see(env)
        if not stepped:
            points = torch.where(began.view(-1, *[1] * (points.ndim - 1)), points, torch.nan)
        dt = torch.where(began, 0.0, self.dt if stepped else 0.0)
        self.emap.reset(mask=began)
        self.emap.update(points, T_map_sensor, T_map_base, dt=dt)
        return self.read(T_map_base)

    @torch.no_grad()
    def read(self, T_map_base: Tensor) -> Tensor:
        """Return what the reader gives as a new float32 tensor (B, ...), 0 where it is not finite."""
        values = self.reader(self.emap, T_map_base)
        if isinstance(values, tuple) and all(isinstance(value, Tensor) for value in values):
            # Values and validity, as height scans give.
            values = torch.stack([value.float() for value in values], 1)
        B = self.emap.num_envs
        fits = isinstance(values, Tensor) and values.ndim > 1 and values.shape[0] == B
        actual = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
        require(fits, "read", f"must return a tensor ({B}, ...)", actual, "give one row for each environment")
        return torch.where(values.isfinite(), values, 0.0).float()

    def read_blank(self) -> Tensor:
        """Return what is read of maps that know nothing, around the origin."""
        return self.read(torch.eye(4, dtype=torch.float64, device=self.device).repeat(self.emap.num_envs, 1, 1))

    def _see(self, env: Any) -> Tensor:
        if self.intrinsics is None:
            return self._ask("points", env)
        return depth_to_points(self._ask("depth", env), self.intrinsics)

    def _ask(self, name: str, env: Any) -> Tensor:
        """Return what the caller's function gives as (B, ...) on the map's device."""
        value = as_tensor(name, self.sources[name](env), self.device)
        floats, hint = value.is_floating_point(), "convert it to floats, in metres"
        require(floats, name, "must return floating-point numbers", value.dtype, hint, TypeError)
        lead = len(self.batch)
        fits = tuple(value.shape[:lead]) == self.batch and value.ndim - lead in (2, 3)
        rule = f"must return ({', '.join([*map(str, self.batch), SHAPES[name]])})"
        hint = "give one for each environment, clouds padded with NaN" if lead else "give that of one environment"
        require(fits, name, rule, tuple(value.shape), hint)
        return value if lead else value[None]


def _check(sources: dict[str, Any], intrinsics: Any, dt: Any) -> None:
    for name in ("T_map_sensor", "T_map_base"):
        actual = type(sources[name]).__name__
        require(callable(sources[name]), name, "must be a function of the environment", actual, "give env -> (4, 4)")
    given = [name for name in ("points", "depth") if callable(sources[name])]
    hint = "give env -> (N, 3), or env -> (h, w) with intrinsics="
    others = [f"{name} = {type(sources[name]).__name__}" for name in ("points", "depth") if sources[name] is not None]
    actual = " and ".join(given) or " and ".join(others) or "neither"
    require(len(given) == 1, "points, depth", "must be one function of the environment", actual, hint)
    paired = (intrinsics is not None) == (given == ["depth"])
    require(paired, "intrinsics", "must come with depth alone", given[0], "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    number = isinstance(dt, Real) and not isinstance(dt, bool) and 0 <= float(dt) < math.inf
    require(number, "dt", "must be seconds", repr(dt), "give the time of one step, such as env.unwrapped.dt")


def as_tensor(name: str, value: Any, device: torch.device) -> Tensor:
    """Return arrays, tensors, or lists of as many as there are environments as one tensor on the device."""
    if isinstance(value, list | tuple) and len(value):
        shapes = sorted({tuple(np.shape(one)) for one in value})
        actual, hint = " and ".join(map(str, shapes)), "pad ragged clouds with NaN"
        require(len(shapes) == 1, name, "must be of one shape", actual, hint)
        value = torch.stack(list(value)) if isinstance(value[0], Tensor) else np.stack(value)
    # NumPy arrays are copied: torch refuses negative strides, and warns of arrays that cannot be written.
    return (value if isinstance(value, Tensor) else torch.from_numpy(np.array(value))).to(device)
