"""Maps that are fed and read through functions of an environment."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig, depth_to_points
from torchelev.errors import require
from torchelev.map_image import MapImage

Source = Callable[[Any], Any]
READ = MapImage(length_x=1.6, length_y=1.0, resolution=0.1, layers=("elevation", "validity"))
SHAPES = {"points": "N, 3", "depth": "h, w", "T_map_sensor": "4, 4", "T_map_base": "4, 4"}  # of one environment


class MapFeed:
    """The maps of B environments, or of one if `num_envs` is None; the arguments are those of the wrappers."""

    def __init__(
        self,
        num_envs: int | None,
        *,
        points: Source | None,
        depth: Source | None,
        intrinsics: Any,
        T_map_sensor: Source | None,
        T_map_base: Source | None,
        dt: float,
        read: Callable[[ElevationMap, Tensor], Any] | None,
        cfg: ElevationMapConfig | None,
        device: torch.device | str,
    ) -> None:
        sources = {"points": points, "depth": depth, "T_map_sensor": T_map_sensor, "T_map_base": T_map_base}
        _check(sources, intrinsics, dt)
        self.sources: dict[str, Any] = sources
        self.batch = () if num_envs is None else (num_envs,)
        self.dt = dt
        self.reader = READ if read is None else read
        self.emap = ElevationMap(cfg, num_envs=num_envs or 1, device=device)
        self.device = self.emap.device
        self.intrinsics = None if intrinsics is None else as_tensor("intrinsics", intrinsics, self.device).double()

    def observe(self, env: Any, began: Tensor, stepped: bool) -> Tensor:
        """Forget where an episode began (B,), fuse one cloud into each map, and read them.

        After a reset of some, the others have not moved: theirs was fused already, and no time has passed.
        """
        T_map_base, T_map_sensor, points = self._ask("T_map_base", env), self._ask("T_map_sensor", env), self._see(env)
        if not stepped:
            points = torch.where(began.view(-1, *[1] * (points.ndim - 1)), points, torch.nan)
        dt = torch.where(began, 0.0, self.dt if stepped else 0.0)
        self.emap.reset(mask=began)
        self.emap.update(points, T_map_sensor, T_map_base, dt)
        return self.read(T_map_base)

    @torch.no_grad()
    def read(self, T_map_base: Tensor) -> Tensor:
        """Return what the reader gives as a new float32 tensor (B, ...), 0 where it is not finite."""
        values = self.reader(self.emap, T_map_base)
        if isinstance(values, tuple):  # values and validity, as height scans give
            values = torch.stack([value.float() for value in values], 1)
        B = self.emap.num_envs
        fits = isinstance(values, Tensor) and values.ndim > 1 and values.shape[0] == B
        came = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
        require(fits, "read", f"must return a tensor ({B}, ...)", came, "give one row for each environment")
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
        floats, mend = value.is_floating_point(), "convert it to floats, in metres"
        require(floats, name, "must return floating-point numbers", value.dtype, mend, TypeError)
        lead = len(self.batch)
        fits = tuple(value.shape[:lead]) == self.batch and value.ndim - lead in (2, 3)
        rule = f"must return ({', '.join([*map(str, self.batch), SHAPES[name]])})"
        mend = "give one for each environment, clouds padded with NaN" if lead else "give that of one environment"
        require(fits, name, rule, tuple(value.shape), mend)
        return value if lead else value[None]


def _check(sources: dict[str, Any], intrinsics: Any, dt: Any) -> None:
    for name in ("T_map_sensor", "T_map_base"):
        came = type(sources[name]).__name__
        require(callable(sources[name]), name, "must be a function of the environment", came, "give env -> (4, 4)")
    given = [name for name in ("points", "depth") if callable(sources[name])]
    mend = "give env -> (N, 3), or env -> (h, w) with intrinsics="
    others = [f"{name} = {type(sources[name]).__name__}" for name in ("points", "depth") if sources[name] is not None]
    came = " and ".join(given) or " and ".join(others) or "neither"
    require(len(given) == 1, "points, depth", "must be one function of the environment", came, mend)
    paired = (intrinsics is not None) == (given == ["depth"])
    require(paired, "intrinsics", "must come with depth alone", given[0], "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    number = isinstance(dt, int | float) and 0 <= dt < math.inf
    require(number, "dt", "must be seconds", repr(dt), "give the time of one step, such as env.unwrapped.dt")


def as_tensor(name: str, value: Any, device: torch.device) -> Tensor:
    """Return arrays, tensors, or lists of as many as there are environments as one tensor on the device."""
    if isinstance(value, list | tuple) and len(value):
        shapes = sorted({tuple(np.shape(one)) for one in value})
        came, mend = " and ".join(map(str, shapes)), "pad ragged clouds with NaN"
        require(len(shapes) == 1, name, "must be of one shape", came, mend)
        value = torch.stack(list(value)) if isinstance(value[0], Tensor) else np.stack(value)
    # NumPy arrays are copied: torch refuses negative strides, and warns of arrays that cannot be written.
    return (value if isinstance(value, Tensor) else torch.from_numpy(np.array(value))).to(device)
