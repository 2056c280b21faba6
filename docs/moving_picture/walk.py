"""The walk: the ground, the robot's smooth path over it, and a map that is updated with each depth image."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.sim import DepthCamera, Scene, cast, mount, outliers, range_noise
from torchelev.sim.exact.scenes import block, steps
from torchelev.sim.poses import pose
from torchelev.sim.waves import natural_waves

SPEED = 0.75  # [m/s]
GRID = GridConfig(resolution=0.04, length_x=12.0, length_y=9.6)
CAMERA, T_BASE_CAMERA = DepthCamera(max_range=4.5), mount(pitch_deg=28.0, x=0.36, z=0.06)
VIEW_RANGE = 2.4  # [m] drawn length of the camera's view
BODY_HEIGHT = 0.47  # [m] of the base over the ground
_WAYPOINTS = ((-3.7, -0.45), (-2.6, -0.05), (-1.0, 0.0), (0.5, 0.0), (1.9, 0.1), (3.0, 0.55), (3.9, 0.9))  # [m]
_BOXES = (
    (-3.1, 1.2, 0.5, 0.4, 0.25), (-2.9, -1.9, 0.4, 0.5, 0.2), (-1.6, 1.7, 0.6, 0.4, 0.32), (-1.2, -2.2, 0.7, 0.4, 0.28),
    (0.0, 1.8, 0.4, 0.7, 0.22), (0.4, -2.3, 0.5, 0.5, 0.35), (1.7, 1.9, 0.9, 0.3, 0.3), (1.6, -1.9, 0.4, 0.4, 0.18),
    (3.1, -0.7, 0.5, 0.6, 0.25), (2.9, -2.0, 0.8, 0.3, 0.3), (3.6, 1.7, 0.4, 0.5, 0.28), (4.7, -0.6, 0.4, 0.9, 0.3),
    (5.0, 1.0, 0.3, 0.8, 0.22),
)  # [m] x, y, length, width and height of the boxes  # fmt: skip
_FINE = 0.01  # [s] between the samples of the path
_FEET = np.stack(np.meshgrid([-0.3, -0.1, 0.1, 0.3], [-0.15, 0.0, 0.15]), -1).reshape(-1, 2)  # [m] base frame


class Moment(NamedTuple):
    """The map after one update."""

    seconds: float  #: [s] since the walk began
    T_map_base: NDArray  #: (4, 4)
    T_map_sensor: NDArray  #: (4, 4)
    view: NDArray  #: (R, 3) [m] ends of the rays along the rim of the image, map frame
    xy: NDArray  #: (H, W, 2) [m] centres of the cells
    elevation: NDArray  #: (H, W) [m], NaN where unknown
    variance: NDArray  #: (H, W) [m^2], NaN where unknown


def make_ground() -> Scene:
    """Build stairs up to a platform, a ramp down, a wall, and boxes on rough ground."""
    relief, gradient, top = natural_waves(5, amplitude=0.05), math.tan(math.radians(14.0)), 0.52

    def terrain(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        ramp = torch.minimum(gradient * (2.72 - x), 1.2 * (1.35 - y.abs())).clamp(0.0, top)
        ramp = torch.where(x < 0.2, 0.0, ramp) if bool((x > 0.2).any()) else torch.zeros_like(x)
        return ramp + relief(x, y) * (1.6 * torch.maximum(-(x + 2.5), y.abs() - 1.5)).clamp(0.0, 1.0)

    climb = steps(-2.013, -1.0, 1.0, count=4, rise=0.13, run=0.3)
    platform = block(-2.013 + 4 * 0.3, 0.65, -1.0, 1.0, top)
    aside = [block(x, x + a, y, y + b, top) for x, y, a, b, top in _BOXES]
    return Scene(name="walk", terrain=terrain, steepness=1.6, boxes=(*climb, platform, *aside))


class Path:
    """A smooth path over the ground; the base follows the ground under its footprint.

    Args:
        scene: the ground.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        corners = np.array(_WAYPOINTS)
        along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))]
        self.seconds = float(along[-1]) / SPEED
        self._times = np.arange(0.0, self.seconds + _FINE, _FINE)
        spline = CubicSpline(along, corners)
        xy, (dx, dy) = spline(self._times * SPEED), spline(self._times * SPEED, 1).T
        yaw = np.unwrap(np.arctan2(dy, dx))
        z, pitch = self._fit(xy, yaw)
        self._values = np.column_stack([xy, z + BODY_HEIGHT, yaw, pitch])

    def base(self, seconds: float) -> NDArray:
        """Return T_map_base (4, 4) at a time [s]."""
        x, y, z, yaw, pitch = (np.interp(seconds, self._times, column) for column in self._values.T)
        return pose(torch.tensor([x, y, z], dtype=torch.float64), yaw, pitch).numpy()

    def ground(self, xy: NDArray) -> NDArray:
        """Return the height of the ground [m] at xy (..., 2) [m]."""
        return self.scene.truth(torch.from_numpy(xy)).numpy()

    def _fit(self, xy: NDArray, yaw: NDArray) -> tuple[NDArray, NDArray]:
        """Return the smoothed height [m] and pitch [rad] of the ground under the footprint."""
        cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        feet = np.stack([cos * _FEET[:, 0] - sin * _FEET[:, 1], sin * _FEET[:, 0] + cos * _FEET[:, 1]], -1)
        z = self.ground(xy[:, None] + feet)
        slope = z @ _FEET[:, 0] / np.square(_FEET[:, 0]).sum()
        return gaussian_filter1d(z.mean(1), 0.2 / _FINE), gaussian_filter1d(-np.arctan(slope), 0.2 / _FINE)


def walk(path: Path, frames_per_second: float, seconds: float | None = None) -> Iterator[Moment]:
    """Walk the path and yield the map after each depth image, which has range noise and 0.5 % of wrong pixels."""
    emap, generator = ElevationMap(ElevationMapConfig(grid=GRID)), torch.Generator().manual_seed(0)
    dt = 1 / frames_per_second
    for k in range(round((path.seconds if seconds is None else seconds) * frames_per_second)):
        T_base = torch.from_numpy(path.base(k * dt))
        T_sensor = T_base @ T_BASE_CAMERA
        points = range_noise(CAMERA.cast(path.scene, T_sensor), generator)
        points = outliers(points, generator, dust=0.002, flying=0.003)
        emap.update(points[None], T_sensor[None], T_base[None], dt if k else 0.0)
        layers = [emap.layer(name)[0].numpy() for name in ("elevation", "variance")]
        rim = _rim(path.scene, T_sensor)
        yield Moment(k * dt, T_base.numpy(), T_sensor.numpy(), rim, emap.cell_centers()[0].numpy(), *layers)


def _rim(scene: Scene, T_map_sensor: torch.Tensor) -> NDArray:
    """Return where the rays along the rim of the image end (R, 3) [m], at most `VIEW_RANGE` away, counted around it."""
    rays = CAMERA.directions.view(CAMERA.height, CAMERA.width, 3)[:: CAMERA.height - 1]
    sides = CAMERA.directions.view(CAMERA.height, CAMERA.width, 3)[:, :: CAMERA.width - 1]
    around = torch.cat([rays[0], sides[1:-1, 1], rays[1].flip(0), sides[1:-1, 0].flip(0)]) @ T_map_sensor[:3, :3].T
    distance = cast(scene, T_map_sensor[:3, 3], around, VIEW_RANGE).nan_to_num(VIEW_RANGE)
    return (T_map_sensor[:3, 3] + around * distance[:, None]).numpy()
