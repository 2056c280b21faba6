"""Yards: open ground with cars, walls, trees, hedges and grass, which the lidar on a vehicle's mast sees."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.sim import HeightField, Lidar, MountedSensor, PoseErrors, SensorErrors, mount, preset
from torchelev.sim.poses import pose
from torchelev.sim.waves import natural_waves
from training.traversability.maps.mapping import Look

LENGTH, RESOLUTION = 24.0, 0.05  # [m] side of a yard and distance of its samples
_INTERVAL = 0.3  # [s] between scans
_ROAD = 1.5  # [m] half the width of the way that is kept free of things
_MASTS = (0.4, 2.0)  # [m] heights of the lidar
_STEPS = (0.1, 1.5)  # [m] between scans
_NUM_THINGS = (4, 14)  # that are drawn, the last number excluded; those on the way are left out
_RINGS, _AZIMUTHS = (16, 32, 64, 128), (256, 1024)  # of the lidar
_RANGE = 20.0  # [m]
_GRASS = 0.35  # [m] of the highest


class Way(NamedTuple):
    """A straight way through a yard."""

    start: np.ndarray  #: (2,) [m]
    heading: float  #: [rad]
    step: float  #: [m] from scan to scan

    def places(self, count: int) -> np.ndarray:
        """Return the places (count, 2) [m] of the scans."""
        ahead = np.array([math.cos(self.heading), math.sin(self.heading)])
        return self.start + self.step * np.arange(count)[:, None] * ahead

    def distance(self, x: Tensor, y: Tensor, count: int) -> Tensor:
        """Return the distance [m] of places from the part that is driven."""
        dx, dy = x - self.start[0], y - self.start[1]
        along = (math.cos(self.heading) * dx + math.sin(self.heading) * dy).clamp(0, self.step * (count - 1))
        return torch.hypot(dx - along * math.cos(self.heading), dy - along * math.sin(self.heading))


def draw_way(count: int, rng: np.random.Generator) -> Way:
    """Draw a way of so many scans, whose middle is near the middle of the yard."""
    heading, step = rng.uniform(-math.pi, math.pi), rng.uniform(*_STEPS)
    middle = rng.uniform(-2, 2, 2)
    half = step * (count - 1) / 2 * np.array([math.cos(heading), math.sin(heading)])
    return Way(middle - half, heading, step)


def make_yard(way: Way, count: int, rng: np.random.Generator) -> Tensor:
    """Return the heights (H, W) [m] of a yard at random, whose things leave the way free."""
    axis = (torch.arange(round(LENGTH / RESOLUTION) + 1, dtype=torch.float64) - LENGTH / RESOLUTION / 2) * RESOLUTION
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    is_way = way.distance(x, y, count) < _ROAD
    ground = _ground(x, y, rng)
    top = torch.zeros_like(ground)
    for _ in range(int(rng.integers(*_NUM_THINGS))):
        draw = _THINGS[int(rng.integers(len(_THINGS)))]
        place, turn = rng.uniform(-LENGTH / 2, LENGTH / 2, 2), rng.uniform(-math.pi, math.pi)
        u = math.cos(turn) * (x - place[0]) + math.sin(turn) * (y - place[1])
        v = math.cos(turn) * (y - place[1]) - math.sin(turn) * (x - place[0])
        thing = draw(u, v, rng)
        if not bool((thing * is_way).any()):
            top = torch.maximum(top, thing)
    return (ground + top).float()


def _ground(x: Tensor, y: Tensor, rng: np.random.Generator) -> Tensor:
    """Return tilted and rolling ground, with a kerb or a ditch at times, and with grass in patches."""
    seed, (a, b) = int(rng.integers(2**31)), rng.uniform(-0.1, 0.1, 2)
    waves, hills = natural_waves(seed, rng.uniform(0, 0.12)), natural_waves(seed + 1, rng.uniform(0, 0.6))
    ground = a * x + b * y + waves(x, y) + hills(x / 5, y / 5)
    turn = rng.uniform(-math.pi, math.pi)
    across = math.cos(turn) * x + math.sin(turn) * y - rng.uniform(-5, 5)
    if rng.random() < 0.4:
        ground = ground + rng.uniform(0.05, 0.4) * (across > 0)
    if rng.random() < 0.3:
        ground = ground - rng.uniform(0.2, 1.5) * torch.exp(-((across - 1) / rng.uniform(0.3, 1.0)).square())
    if rng.random() < 0.6:
        patches = natural_waves(seed + 2, 1.0)(x / 3, y / 3).clamp(0, 1)
        ground = ground + _noise(x.shape, rng) * patches * rng.uniform(0, _GRASS)
    return ground


def _noise(shape: tuple[int, ...], rng: np.random.Generator) -> Tensor:
    """Return blades and tufts: random heights from 0 to 1, smooth over one to a few samples."""
    blades = torch.from_numpy(rng.random(shape))
    return blades * F.avg_pool2d(torch.from_numpy(rng.random((1, 1, *shape))), 9, 1, 4)[0, 0] * 2


def _car(u: Tensor, v: Tensor, rng: np.random.Generator) -> Tensor:
    length, width = rng.uniform(3.6, 5.0), rng.uniform(1.6, 2.0)
    body = (u.abs() < length / 2) & (v.abs() < width / 2)
    cabin = ((u + 0.1 * length).abs() < 0.3 * length) & body
    return torch.where(cabin, rng.uniform(1.3, 1.9), torch.where(body, rng.uniform(0.7, 1.0), 0.0))


def _wall(u: Tensor, v: Tensor, rng: np.random.Generator) -> Tensor:
    is_wall = (u.abs() < rng.uniform(1, 5)) & (v.abs() < rng.uniform(0.1, 0.3))
    return rng.uniform(0.5, 3.0) * is_wall


def _house(u: Tensor, v: Tensor, rng: np.random.Generator) -> Tensor:
    return rng.uniform(2.0, 3.0) * ((u.abs() < rng.uniform(1, 4)) & (v.abs() < rng.uniform(1, 4)))


def _trunk(u: Tensor, v: Tensor, rng: np.random.Generator) -> Tensor:
    return rng.uniform(1.0, 3.0) * (torch.hypot(u, v) < rng.uniform(0.08, 0.35))


def _bush(u: Tensor, v: Tensor, rng: np.random.Generator) -> Tensor:
    radius, height = rng.uniform(0.4, 1.8), rng.uniform(0.3, 1.8)
    dome = (1 - torch.hypot(u, v * rng.uniform(0.4, 1.0)).square() / radius**2).clamp(min=0).sqrt()
    return height * dome * (0.6 + 0.4 * torch.from_numpy(rng.random(u.shape)))


def _rock(u: Tensor, v: Tensor, rng: np.random.Generator) -> Tensor:
    return rng.uniform(0.1, 0.6) * (torch.hypot(u, v * rng.uniform(0.5, 1.0)) < rng.uniform(0.1, 0.6))


_THINGS: tuple[Callable[[Tensor, Tensor, np.random.Generator], Tensor], ...] = (
    _car,
    _wall,
    _house,
    _trunk,
    _bush,
    _rock,
)


def drive_and_look(num: int, count: int, rng: np.random.Generator) -> tuple[HeightField, Iterator[Look]]:
    """Return yards and the scans of a vehicle in each, which share the lidar and its mast."""
    ways = [draw_way(count, rng) for _ in range(num)]
    field = HeightField(torch.stack([make_yard(way, count, rng) for way in ways]), RESOLUTION)
    return field, _scans(field, ways, count, rng)


def _scans(field: HeightField, ways: list[Way], count: int, rng: np.random.Generator) -> Iterator[Look]:
    num, tiles = len(ways), torch.arange(len(ways))
    rings, azimuths = int(rng.choice(_RINGS)), int(rng.integers(*_AZIMUTHS))
    low, high = rng.uniform(-60, -15), rng.uniform(5, 45)
    sensor = MountedSensor(Lidar(rings, azimuths, low, high, _RANGE), mount(0.0, z=rng.uniform(*_MASTS)))
    errors = SensorErrors(preset("spinning_lidar").sensor, num, seed=int(rng.integers(2**31)))
    odometry = PoseErrors(preset("leg_odometry").pose, num, seed=int(rng.integers(2**31)))
    T_map_tile = pose(torch.from_numpy(rng.uniform(-20, 20, (num, 3))), torch.from_numpy(rng.uniform(-3, 3, num)))
    xy = torch.from_numpy(np.stack([way.places(count) for way in ways], 1))  # (count, num, 2)
    yaw = torch.tensor([way.heading for way in ways], dtype=torch.float64)
    for k in range(count):
        z = field.height(tiles, xy[k, :, None].float())[:, 0].double()
        T_tile_base = pose(torch.cat([xy[k], z[:, None]], 1), yaw)
        T_map_base = T_map_tile @ odometry(T_tile_base, _INTERVAL)
        points = sensor(field, tiles, T_tile_base)
        cloud = errors(points, sensor.T_map_sensor(T_map_base), image_shape=(rings, azimuths))
        yield Look(cloud.points[:, None], cloud.T_map_sensor[:, None], T_map_base, T_tile_base)
