"""Sensors that see a scene exactly: each ray's first hit, on vertical faces too, to well below 0.1 mm."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchelev.sim.scenes import Box, Scene

FINEST = 0.02  # [m] shortest step along a ray while looking for the terrain
BISECTIONS = 12  # 0.02 m / 2^12 = 5 um
MAX_STEPS = 2000


class _Sensor:
    """What casts rays: `directions` in its own frame and a range."""

    max_range: float

    @property
    def directions(self) -> Tensor:
        """Unit vectors (M, 3) in the sensor frame, x forward, y left, z up."""
        raise NotImplementedError

    def cast(self, scene: Scene, T_map_sensor: Tensor, t: float = 0.0) -> Tensor:
        """Return the points (M, 3) [m] seen at time t [s] in the SENSOR frame, float32, NaN where nothing was hit."""
        T = T_map_sensor.double()
        distance = cast(scene, T[:3, 3], self.directions @ T[:3, :3].T, self.max_range, t)
        return (self.directions * distance[:, None]).float()


@dataclass(frozen=True)
class DepthCamera(_Sensor):
    """A pinhole camera. Sensor frame: x forward, y left, z up. Rays row by row from the upper left pixel."""

    width: int = 160
    height: int = 120
    fov_x_deg: float = 86.0
    fov_y_deg: float = 58.0
    max_range: float = 8.0  # [m]

    @cached_property
    def directions(self) -> Tensor:
        """Unit vectors (height * width, 3), through the middles of the pixels."""
        across, down = math.tan(math.radians(self.fov_x_deg) / 2), math.tan(math.radians(self.fov_y_deg) / 2)
        left = across * (1 - 2 * (torch.arange(self.width, dtype=torch.float64) + 0.5) / self.width)
        up = down * (1 - 2 * (torch.arange(self.height, dtype=torch.float64) + 0.5) / self.height)
        z, y = torch.meshgrid(up, left, indexing="ij")
        rays = torch.stack([torch.ones_like(y), y, z], -1).reshape(-1, 3)
        return rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)


@dataclass(frozen=True)
class Lidar(_Sensor):
    """A turning lidar. Sensor frame: x forward, y left, z up. Rays ring by ring from the lowest."""

    rings: int = 32
    azimuths: int = 1024
    fov_low_deg: float = -55.0
    fov_high_deg: float = 15.0
    max_range: float = 20.0  # [m]

    @cached_property
    def directions(self) -> Tensor:
        """Unit vectors (rings * azimuths, 3)."""
        elevation = torch.linspace(self.fov_low_deg, self.fov_high_deg, self.rings, dtype=torch.float64).deg2rad()
        azimuth = (torch.arange(self.azimuths, dtype=torch.float64) + 0.5) / self.azimuths * 2 * math.pi - math.pi
        e, a = torch.meshgrid(elevation, azimuth, indexing="ij")
        return torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin()], -1).reshape(-1, 3)


def cast(scene: Scene, origin: Tensor, directions: Tensor, max_range: float, t: float = 0.0) -> Tensor:
    """Return the distance (M,) [m] to the first hit of each ray, NaN where there is none within `max_range`.

    `origin` (3,) [m] and unit `directions` (M, 3) in the map frame, float64.
    """
    nearest = torch.full_like(directions[:, 0], math.inf)
    for box in scene.boxes:
        if box.exists(t):
            nearest = torch.minimum(nearest, cast_box(box, origin, directions, t))
    nearest = torch.minimum(nearest, cast_terrain(scene, origin, directions, nearest.clamp(max=max_range)))
    return torch.where(nearest <= max_range, nearest, math.nan)


def cast_box(box: Box, origin: Tensor, directions: Tensor, t: float = 0.0) -> Tensor:
    """Return the distance (M,) to where each ray enters the box (slab method), inf where it misses."""
    low, high = box.corners(t)
    enter = torch.zeros_like(directions[:, 0])
    leave = torch.full_like(enter, math.inf)
    for axis in range(3):
        # A ray parallel to the slab would divide zero by zero on the face; a tiny slope keeps it outside or inside.
        along = directions[:, axis]
        inverse = 1.0 / torch.where(along.abs() < 1e-12, 1e-12, along)
        a, b = (low[axis] - origin[axis]) * inverse, (high[axis] - origin[axis]) * inverse
        enter, leave = torch.maximum(enter, torch.minimum(a, b)), torch.minimum(leave, torch.maximum(a, b))
    return torch.where(enter <= leave, enter, math.inf)


def cast_terrain(scene: Scene, origin: Tensor, directions: Tensor, reach: Tensor) -> Tensor:
    """Return the distance (M,) to the terrain within `reach` (M,), inf where there is none.

    With f the height over the terrain and s its steepness, no ray can meet the terrain within f / (s |d_xy| - d_z):
    that is how far each step goes. Once that is below 2 cm, steps of 2 cm find the crossing, which is then bisected.
    """
    crossed = torch.full_like(reach, math.nan)
    sinking = scene.steepness * torch.linalg.vector_norm(directions[:, :2], dim=-1) - directions[:, 2]
    rays = torch.nonzero(sinking > 0)[:, 0]  # the others climb faster than the terrain can
    along = torch.zeros_like(rays, dtype=reach.dtype)
    for _ in range(MAX_STEPS):
        if not len(rays):
            break
        over = _over_terrain(scene, origin, directions[rays], along)
        hit = over <= 0
        crossed[rays[hit]] = along[hit]
        # Just short of the safe step, so that only a short last step can cross and the bracket stays short.
        along = along + (0.999 * over / sinking[rays]).clamp(min=FINEST)
        going = ~hit & (along < reach[rays] + FINEST)
        rays, along = rays[going], along[going]
    hits = torch.nonzero(crossed.isfinite())[:, 0]
    result = torch.full_like(reach, math.inf)
    result[hits] = _bisect(scene, origin, directions[hits], crossed[hits])
    return result


def _over_terrain(scene: Scene, origin: Tensor, directions: Tensor, along: Tensor) -> Tensor:
    x, y, z = (origin[i] + directions[:, i] * along for i in range(3))
    return z - scene.terrain(x, y)


def _bisect(scene: Scene, origin: Tensor, directions: Tensor, beyond: Tensor) -> Tensor:
    near, far = (beyond - FINEST).clamp(min=0), beyond
    for _ in range(BISECTIONS):
        middle = (near + far) / 2
        above = _over_terrain(scene, origin, directions, middle) > 0
        near, far = torch.where(above, middle, near), torch.where(above, far, middle)
    return (near + far) / 2
