"""Sensors for exact scenes: the first hit of each ray, on vertical faces too, to well below 0.1 mm."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.sim.exact.scenes import Box, Scene

_MIN_STEP = 0.02  # [m] along a ray in the search for the terrain
_BISECTIONS = 12  # 0.02 m / 2^12 = 5 um
_MAX_STEPS = 2000


class _Sensor:
    """A sensor with a fixed pattern of rays."""

    max_range: float

    @property
    def directions(self) -> Tensor:
        """Unit vectors (M, 3) in the sensor frame, x forward, y left, z up."""
        raise NotImplementedError

    def cast(self, scene: Scene, T_map_sensor: Tensor, t: float = 0.0) -> Tensor:
        """Return the points (M, 3) [m] seen at time t [s], sensor frame, float32, NaN where nothing is hit."""
        return _cast_points(self.directions, scene, T_map_sensor, self.max_range, t)


def _cast_points(directions: Tensor, scene: Scene, T_map_sensor: Tensor, max_range: float, t: float = 0.0) -> Tensor:
    """Return the points (M, 3) [m] hit by rays (M, 3), both in the sensor frame, NaN where nothing is hit."""
    T = T_map_sensor.double()
    distance = cast(scene, T[:3, 3], directions @ T[:3, :3].T, max_range, t)
    return (directions * distance[:, None]).float()


@dataclass(frozen=True)
class DepthCamera(_Sensor):
    """A pinhole camera; its rays go row by row from the upper left pixel. Sensor frame: x forward, y left, z up."""

    width: int = 160  #: [pixels] of a row
    height: int = 120  #: [pixels] of a column
    fov_x_deg: float = 86.0  #: [deg] horizontal field of view
    fov_y_deg: float = 58.0  #: [deg] vertical field of view
    max_range: float = 8.0  #: [m] beyond which nothing is hit
    pinhole: tuple[float, float, float, float] | None = None  #: [pixels] fx, fy, cx, cy; replaces the fields of view

    @classmethod
    def from_intrinsics(
        cls, fx: float, fy: float, cx: float, cy: float, width: int, height: int, max_range: float = 8.0
    ) -> DepthCamera:
        """Make a camera from its intrinsics; the centre of the upper left pixel is (0, 0).

        Args:
            fx: Horizontal focal length [pixels].
            fy: Vertical focal length [pixels].
            cx: Column of the principal point [pixels].
            cy: Row of the principal point [pixels].
            width: Pixels of a row.
            height: Pixels of a column.
            max_range: Range beyond which nothing is hit [m].

        Raises:
            ValueError: A focal length is not positive.
        """
        require(fx > 0 and fy > 0, "fx, fy", "must be positive", (fx, fy), "give the focal lengths in pixels")
        fov_x, fov_y = (
            math.degrees(math.atan((c + 0.5) / f) + math.atan((size - 0.5 - c) / f))
            for f, c, size in ((fx, cx, width), (fy, cy, height))
        )
        return cls(width, height, fov_x, fov_y, max_range, (fx, fy, cx, cy))

    @cached_property
    def intrinsics(self) -> Tensor:
        """The matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] [pixels], float64, as `depth_to_points` takes it."""
        fx, fy = (
            size / 2 / math.tan(math.radians(fov) / 2)
            for size, fov in ((self.width, self.fov_x_deg), (self.height, self.fov_y_deg))
        )
        fx, fy, cx, cy = self.pinhole or (fx, fy, (self.width - 1) / 2, (self.height - 1) / 2)
        return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)

    @cached_property
    def directions(self) -> Tensor:
        """Unit vectors (height * width, 3) through the pixel centres."""
        u, v = (torch.arange(size, dtype=torch.float64) for size in (self.width, self.height))
        if self.pinhole is None:
            across, down = math.tan(math.radians(self.fov_x_deg) / 2), math.tan(math.radians(self.fov_y_deg) / 2)
            left, up = across * (1 - 2 * (u + 0.5) / self.width), down * (1 - 2 * (v + 0.5) / self.height)
        else:
            fx, fy, cx, cy = self.pinhole
            left, up = (cx - u) / fx, (cy - v) / fy
        z, y = torch.meshgrid(up, left, indexing="ij")
        rays = torch.stack([torch.ones_like(y), y, z], -1).reshape(-1, 3)
        return rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)


@dataclass(frozen=True)
class Lidar(_Sensor):
    """A spinning lidar; its rays go ring by ring from the lowest. Sensor frame: x forward, y left, z up."""

    rings: int = 32  #: number of beams, one above the other
    azimuths: int = 1024  #: measurements of each beam in a turn
    fov_low_deg: float = -55.0  #: [deg] elevation of the lowest beam
    fov_high_deg: float = 15.0  #: [deg] elevation of the highest beam
    max_range: float = 20.0  #: [m] beyond which nothing is hit

    @cached_property
    def directions(self) -> Tensor:
        """Unit vectors (rings * azimuths, 3)."""
        elevation = torch.linspace(self.fov_low_deg, self.fov_high_deg, self.rings, dtype=torch.float64).deg2rad()
        azimuth = (torch.arange(self.azimuths, dtype=torch.float64) + 0.5) / self.azimuths * 2 * math.pi - math.pi
        e, a = torch.meshgrid(elevation, azimuth, indexing="ij")
        return torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin()], -1).reshape(-1, 3)


@dataclass(frozen=True)
class NonRepetitiveLidar:
    """A lidar with a non-repetitive scan pattern like Livox's: every step covers another part of the field of view.

    Two prisms that rotate at speeds 1 + k and 1 - k deflect the beam by equal angles. Their sum is a rose curve
    (rhodonea): with rho the angle from the sensor's x axis and theta the angle around it, rho = fov / 2 * cos(k theta);
    see Brazeal et al., "A Rigorous Observation Model for the Risley Prism-Based Livox Mid-40 Lidar Sensor" (Sensors
    2021), and "Symmetries of Scan Patterns of Laser Scanners with Rotational Risley Prisms" (Symmetry 2023). With an
    irrational k the curve never closes. Speeds, channels and timing of real sensors differ. Sensor frame: x forward,
    y left, z up.
    """

    rays: int = 1024  #: number of rays in a step
    fov_deg: float = 70.0  #: [deg] full opening angle of the cone; chosen
    turns: float = 4.618  #: turns of theta in a step; chosen
    k: float = 3.618033988749895  #: half petals in a turn; chosen: 2 plus the golden ratio
    max_range: float = 20.0  #: [m] beyond which nothing is hit

    def directions(self, step: int | Tensor) -> Tensor:
        """Return the unit vectors of a step, float64: (rays, 3), or (B, rays, 3) for steps (B,) on their device."""
        step = step if isinstance(step, Tensor) else torch.full((), step)
        ray = step.to(torch.float64)[..., None] * self.rays + torch.arange(self.rays, device=step.device)
        theta = ray * (2 * math.pi * self.turns / self.rays)
        rho = math.radians(self.fov_deg / 2) * (self.k * theta).cos()
        return torch.stack([rho.cos(), rho.sin() * theta.cos(), rho.sin() * theta.sin()], -1)

    def cast(self, scene: Scene, T_map_sensor: Tensor, t: float = 0.0, step: int = 0) -> Tensor:
        """Return the points (rays, 3) [m] seen in a step, sensor frame, float32, NaN where nothing is hit."""
        return _cast_points(self.directions(step), scene, T_map_sensor, self.max_range, t)


def cast(scene: Scene, origin: Tensor, directions: Tensor, max_range: float, t: float = 0.0) -> Tensor:
    """Return the distance (M,) [m] to the first hit of each ray, NaN where there is none within `max_range`.

    Args:
        scene: The scene to cast into.
        origin: Common origin (3,) [m] of the rays, map frame, float64.
        directions: Unit vectors (M, 3), map frame, float64.
        max_range: Longest distance that is returned [m].
        t: Time [s].
    """
    nearest = torch.full_like(directions[:, 0], math.inf)
    for box in scene.boxes:
        if box.exists(t):
            nearest = torch.minimum(nearest, _cast_box(box, origin, directions, t))
    nearest = torch.minimum(nearest, _cast_terrain(scene, origin, directions, nearest.clamp(max=max_range)))
    return torch.where(nearest <= max_range, nearest, math.nan)


def _cast_box(box: Box, origin: Tensor, directions: Tensor, t: float = 0.0) -> Tensor:
    """Return the distance (M,) [m] at which each ray enters the box (slab method), inf where it misses."""
    low, high = box.corners(t)
    enter = torch.zeros_like(directions[:, 0])
    leave = torch.full_like(enter, math.inf)
    for axis in range(3):
        # For a ray parallel to the slab and on its face 0 / 0 would be NaN; a tiny slope decides on one side.
        along = directions[:, axis]
        inverse = 1.0 / torch.where(along.abs() < 1e-12, 1e-12, along)
        a, b = (low[axis] - origin[axis]) * inverse, (high[axis] - origin[axis]) * inverse
        enter, leave = torch.maximum(enter, torch.minimum(a, b)), torch.minimum(leave, torch.maximum(a, b))
    return torch.where(enter <= leave, enter, math.inf)


def _cast_terrain(scene: Scene, origin: Tensor, directions: Tensor, reach: Tensor) -> Tensor:
    """Return the distance (M,) [m] to the terrain within `reach` (M,) [m], inf where there is none.

    With f the height over the terrain and s its steepness, a ray of direction d cannot meet the terrain within
    f / (s |d_xy| - d_z), which is the length of each step. Where that falls below 2 cm, steps of 2 cm find the
    crossing, which is then bisected.
    """
    crossing = torch.full_like(reach, math.nan)
    sinking = scene.steepness * torch.linalg.vector_norm(directions[:, :2], dim=-1) - directions[:, 2]
    rays = torch.nonzero(sinking > 0)[:, 0]  # all others climb faster than the terrain
    along = torch.zeros_like(rays, dtype=reach.dtype)
    for _ in range(_MAX_STEPS):
        if not len(rays):
            break
        clearance = _height_over_terrain(scene, origin, directions[rays], along)
        hit = clearance <= 0
        crossing[rays[hit]] = along[hit]
        # Slightly less than the safe step: only a step of the minimal length can cross, so the bracket stays short.
        along = along + (0.999 * clearance / sinking[rays]).clamp(min=_MIN_STEP)
        continues = ~hit & (along < reach[rays] + _MIN_STEP)
        rays, along = rays[continues], along[continues]
    hits = torch.nonzero(crossing.isfinite())[:, 0]
    result = torch.full_like(reach, math.inf)
    result[hits] = _bisect(scene, origin, directions[hits], crossing[hits])
    return result


def _height_over_terrain(scene: Scene, origin: Tensor, directions: Tensor, along: Tensor) -> Tensor:
    x, y, z = (origin[i] + directions[:, i] * along for i in range(3))
    return z - scene.terrain(x, y)


def _bisect(scene: Scene, origin: Tensor, directions: Tensor, beyond: Tensor) -> Tensor:
    """Return where rays cross the terrain, at most one minimal step before `beyond` (M,) [m]."""
    near, far = (beyond - _MIN_STEP).clamp(min=0), beyond
    for _ in range(_BISECTIONS):
        middle = (near + far) / 2
        above = _height_over_terrain(scene, origin, directions, middle) > 0
        near, far = torch.where(above, middle, near), torch.where(above, far, middle)
    return (near + far) / 2
