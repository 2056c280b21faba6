"""Feed maps from any simulator, through functions of its environment."""

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
_SHAPES = {  # of one environment
    **{"points": "N, 3", "depth": "h, w"},
    **{"T_map_sensor": "4, 4", "T_map_base": "4, 4", "T_base_links": "K, 4, 4"},
}


class MapFeed:
    """Maps of the B environments of any simulator, updated with one cloud per reset and step.

    The functions below get the environment that `observe` is called with. They return arrays or tensors with a leading
    dimension B, or without it if `num_envs` is None.

    Args:
        num_envs: B, or None for a single environment.
        points: env -> (B, N, 3) or (B, S, N, 3) [m], sensor frame; NaN points are ignored.
        depth: env -> (B, h, w) or (B, S, h, w) [m] along the optical axis, instead of `points`.
        intrinsics: (3, 3) [pixels], required with `depth`. The sensor frame is then x right, y down, z forward.
        T_map_sensor: env -> (B, 4, 4) or (B, S, 4, 4), sensor frame to map frame.
        T_map_base: env -> (B, 4, 4), base frame to map frame; the map's window follows the base.
        T_base_links: env -> (B, K, 4, 4), poses of the links; required if `cfg.sensor.body` is a RobotBody.
        dt: duration of one step [s].
        read: (emap, T_map_base) -> observation (B, ...), or values and validity, which are stacked to (B, 2, ...);
            those of a `HeightScan` with channels follow each other: (B, 2 (1 + C), P).
            None: `DEFAULT_READ`, the elevation relative to the base and its validity every 0.1 m of 1.6 x 1.0 m.
        cfg: config of the map.
        device: device of the map.

    Raises:
        ValueError, TypeError: for a missing argument or a wrong value.
    """

    def __init__(
        self,
        num_envs: int | None,
        *,
        T_map_sensor: Source | None,
        T_map_base: Source | None,
        T_base_links: Source | None = None,
        dt: float | None,
        points: Source | None = None,
        depth: Source | None = None,
        intrinsics: Any = None,
        read: Callable[[ElevationMap, Tensor], Any] | None = None,
        cfg: ElevationMapConfig | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        sources = {"points": points, "depth": depth, "T_map_sensor": T_map_sensor, "T_map_base": T_map_base}
        _check_arguments(sources, intrinsics, dt)
        links = cfg.sensor.links if isinstance(cfg, ElevationMapConfig) else ()
        rule, actual = "must be a function if cfg.sensor.body has links, and only then", type(T_base_links).__name__
        require(
            callable(T_base_links) == bool(links), "T_base_links", rule, actual, "give env -> (K, 4, 4), or neither"
        )
        self.sources: dict[str, Any] = sources | {"T_base_links": T_base_links}
        self.batch = () if num_envs is None else (num_envs,)
        self.dt = float(dt)  # type: ignore[arg-type]
        self.reader = DEFAULT_READ if read is None else read
        self.emap = ElevationMap(cfg, num_envs=1 if num_envs is None else num_envs, device=device)
        self.device = self.emap.device
        self.intrinsics = None if intrinsics is None else as_tensor("intrinsics", intrinsics, self.device).double()

    def observe(self, env: Any, began: Tensor, stepped: bool) -> Tensor:
        """Reset the maps of new episodes, fuse one cloud into each map, and read the maps.

        Args:
            env: the environment that the functions get.
            began: (B,) bool, True where an episode began.
            stepped: True after a step; False after a reset of the environments that `began`. The others have then not
                moved: no time has passed, and their cloud is not fused a second time.

        Returns:
            The observation (B, ...) that `read` returns, float32.
        """
        T_map_base, T_map_sensor = self._call("T_map_base", env), self._call("T_map_sensor", env)
        points = self._read_points(env)
        if not stepped:
            points = torch.where(began.view(-1, *[1] * (points.ndim - 1)), points, torch.nan)
        dt = torch.where(began, 0.0, self.dt if stepped else 0.0)
        self.emap.reset(mask=began)
        links = None if self.sources["T_base_links"] is None else self._call("T_base_links", env)
        self.emap.update(points, T_map_sensor, T_map_base, dt=dt, T_base_links=links)
        return self.read(T_map_base)

    @torch.no_grad()
    def read(self, T_map_base: Tensor) -> Tensor:
        """Read the maps as a new float32 tensor (B, ...), 0 where the reader's values are not finite."""
        values = self.reader(self.emap, T_map_base)
        if isinstance(values, tuple) and all(isinstance(value, Tensor) for value in values):
            # Values and validity, as height scans return them.
            join = torch.cat if getattr(self.reader, "channels", ()) else torch.stack  # both have rows of channels
            values = join([value.float() for value in values], 1)
        B = self.emap.num_envs
        fits = isinstance(values, Tensor) and values.ndim > 1 and values.shape[0] == B
        actual = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
        require(fits, "read", f"must return a tensor ({B}, ...)", actual, "give one row for each environment")
        return torch.where(values.isfinite(), values, 0.0).float()

    def read_blank(self) -> Tensor:
        """Read the maps around the origin: the observation of an empty map, while nothing has been fused."""
        return self.read(torch.eye(4, dtype=torch.float64, device=self.device).repeat(self.emap.num_envs, 1, 1))

    def _read_points(self, env: Any) -> Tensor:
        """Return the clouds, computed from depth images if there are intrinsics."""
        if self.intrinsics is None:
            return self._call("points", env)
        return depth_to_points(self._call("depth", env), self.intrinsics)

    def _call(self, name: str, env: Any) -> Tensor:
        """Call a function of the user and return its result as (B, ...) on the map's device."""
        value = as_tensor(name, self.sources[name](env), self.device)
        is_float, hint = value.is_floating_point(), "convert it to floats, in metres"
        require(is_float, name, "must return floating-point numbers", value.dtype, hint, TypeError)
        batch_dims = len(self.batch)
        fits = tuple(value.shape[:batch_dims]) == self.batch and value.ndim - batch_dims in (2, 3)
        rule = f"must return ({', '.join([*map(str, self.batch), _SHAPES[name]])})"
        hint = "give one for each environment, clouds padded with NaN" if batch_dims else "give that of one environment"
        require(fits, name, rule, tuple(value.shape), hint)
        return value if batch_dims else value[None]


def _check_arguments(sources: dict[str, Any], intrinsics: Any, dt: Any) -> None:
    for name in ("T_map_sensor", "T_map_base"):
        actual = type(sources[name]).__name__
        require(callable(sources[name]), name, "must be a function of the environment", actual, "give env -> (4, 4)")
    functions = [name for name in ("points", "depth") if callable(sources[name])]
    hint = "give env -> (N, 3), or env -> (h, w) with intrinsics="
    values = [f"{name} = {type(sources[name]).__name__}" for name in ("points", "depth") if sources[name] is not None]
    actual = " and ".join(functions) or " and ".join(values) or "neither"
    require(len(functions) == 1, "points, depth", "must be one function of the environment", actual, hint)
    fits, hint = (intrinsics is not None) == (functions == ["depth"]), "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
    require(fits, "intrinsics", "must be given with depth, and only then", functions[0], hint)
    is_time = isinstance(dt, Real) and not isinstance(dt, bool) and 0 <= float(dt) < math.inf
    require(is_time, "dt", "must be seconds", repr(dt), "give the duration of one step, such as env.unwrapped.dt")


def as_tensor(name: str, value: Any, device: torch.device) -> Tensor:
    """Convert an array, a tensor, or a list with one of them for each environment to a tensor on the device."""
    if isinstance(value, list | tuple) and len(value):
        shapes = sorted({tuple(np.shape(item)) for item in value})
        actual, hint = " and ".join(map(str, shapes)), "pad ragged clouds with NaN"
        require(len(shapes) == 1, name, "must be of one shape", actual, hint)
        value = torch.stack(list(value)) if isinstance(value[0], Tensor) else np.stack(value)
    # NumPy arrays are copied: torch refuses negative strides and warns of read-only arrays.
    return (value if isinstance(value, Tensor) else torch.from_numpy(np.array(value))).to(device)
