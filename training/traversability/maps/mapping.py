"""Maps from the sensors of robots that walk over simulated ground, and maps of the true heights.

The map frame is rotated and shifted against the tile's frame, and the robot's estimated pose drifts in it. A map is
relative to its robot, so a cell's true place is where the cell would be if the estimated base were at the true one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.errors import require, require_positive
from torchelev.robot import RobotConfig
from torchelev.sim import HeightField, PoseErrors, preset
from torchelev.sim.poses import pose
from training.traversability.maps.sight import Sight
from training.traversability.maps.terrain import LOOK_INTERVAL, Footing, walks

if TYPE_CHECKING:
    from jaxtyping import Float

EXACT_NOISE = 0.01  # [m] largest white noise (1 sigma) in maps of the true heights
_EXACT_SHIFT = 1.0  # [m] largest distance of their center from the tile's along each axis


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """Settings of the maps."""

    num_maps: int = 2  #: per batch, which shares robot, resolution and sensors
    window: float = 4.0  #: [m] side of a map, rounded to whole cells
    looks: tuple[int, int] = (10, 20)  #: smallest and largest number
    headings: int = 8  #: per label
    camera_pixels: tuple[int, int] = (64, 48)  #: width, height
    lidar_rays: tuple[int, int] = (32, 256)  #: rings, azimuths
    robot: RobotConfig | None = None  #: None: each batch draws its own

    def __post_init__(self) -> None:
        require_positive(window=self.window)
        positive = self.num_maps >= 1 and self.headings >= 1 and 1 <= self.looks[0] <= self.looks[1]
        actual = (self.num_maps, self.headings, self.looks)
        require(positive, "num_maps, headings, looks", "must be at least 1", actual, "see their defaults")


class Look(NamedTuple):
    """The scans of a batch of robots at one instant."""

    points: Float[Tensor, "B S N 3"]  #: [m] sensor frame
    T_map_sensor: Float[Tensor, "B S 4 4"]  #: as estimated
    T_map_base: Float[Tensor, "B 4 4"]  #: as estimated
    T_tile_base: Float[Tensor, "B 4 4"]  #: true


def walk_and_look(
    field: HeightField,
    robot: RobotConfig,
    cfg: DataConfig,
    rng: np.random.Generator,
    path: Float[Tensor, "K B 4 4"] | None = None,
) -> Iterator[Look]:
    """Walk over every tile, on a path of one's own or the given one; yield scans of simulated sensors with errors."""
    num, looks = field.num_tiles, int(rng.integers(cfg.looks[0], cfg.looks[1], endpoint=True))
    path = walks(Footing(field, robot), num, looks, rng) if path is None else path
    sight = Sight(robot, num, cfg.camera_pixels, cfg.lidar_rays, rng)
    odometry = PoseErrors(preset("leg_odometry").pose, num, seed=int(rng.integers(2**31)))
    T_map_tile = _map_frames(num, rng)
    for T_tile_base in path:
        T_map_base = T_map_tile @ odometry(T_tile_base, LOOK_INTERVAL)
        points, T_map_sensor = sight.look(field, T_tile_base, T_map_base)
        yield Look(points, T_map_sensor, T_map_base, T_tile_base)


def walk_and_map(
    field: HeightField,
    robot: RobotConfig,
    resolution: float,
    cfg: DataConfig,
    rng: np.random.Generator,
    path: Float[Tensor, "K B 4 4"] | None = None,
) -> tuple[ElevationMap, Float[Tensor, "B 4 4"]]:
    """Walk over every tile and map it; return the maps and T_tile_map (B, 4, 4) at the last scan."""
    emap = blank_map(resolution, cfg.window, field.num_tiles)
    for look in walk_and_look(field, robot, cfg, rng, path):
        emap.update(look.points, look.T_map_sensor, look.T_map_base, LOOK_INTERVAL)
    return emap, look.T_tile_base @ torch.linalg.inv(look.T_map_base)


def map_config(resolution: float, window: float) -> ElevationMapConfig:
    """Return the configuration of maps of about `window` [m], without a traversability head."""
    length = round(window / resolution) * resolution
    grid = GridConfig(resolution=resolution, length_x=length, length_y=length)
    return ElevationMapConfig(grid=grid, traversability=None)


def blank_map(resolution: float, window: float, num_maps: int) -> ElevationMap:
    """Return empty maps."""
    return ElevationMap(map_config(resolution, window), num_maps)


def _map_frames(num: int, rng: np.random.Generator) -> Tensor:
    """Draw T_map_tile (num, 4, 4) at random, so that edges lie at all angles to the cells."""
    place = torch.from_numpy(rng.uniform(-20, 20, (num, 3)))
    return pose(place, torch.from_numpy(rng.uniform(-math.pi, math.pi, num)))


def exact_maps(
    field: HeightField, resolution: float, cfg: DataConfig, rng: np.random.Generator
) -> tuple[ElevationMap, Float[Tensor, "B 4 4"]]:
    """Return maps of every tile's true heights with white noise, and T_tile_map (B, 4, 4)."""
    emap, num = blank_map(resolution, cfg.window, field.num_tiles), field.num_tiles
    shift = np.append(rng.uniform(-_EXACT_SHIFT, _EXACT_SHIFT, (num, 2)), np.zeros((num, 1)), 1)
    T_tile_map = pose(torch.from_numpy(shift), torch.from_numpy(rng.uniform(-math.pi, math.pi, num)))
    xy = tile_cell_centers(emap, T_tile_map).float()
    heights = field.height(torch.arange(num), xy.flatten(1, 2)).view(xy.shape[:3])
    noise = rng.uniform(0, EXACT_NOISE, (num, 1, 1))
    emap.state.elevation.copy_(heights + torch.from_numpy(noise * rng.standard_normal(heights.shape)))
    emap.state.variance.copy_(torch.from_numpy(noise**2).expand_as(heights))
    emap.state.validity.fill_(True)
    return emap, T_tile_map


def tile_cell_centers(emap: ElevationMap, T_tile_map: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B H W 2"]:
    """Return the true places of the cell centers [m] in the tiles' frames, float64."""
    turned = torch.einsum("bkl,bijl->bijk", T_tile_map[:, :2, :2], emap.cell_centers())
    return turned + T_tile_map[:, None, None, :2, 3]
