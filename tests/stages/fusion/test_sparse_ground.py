"""Sparse measurements of planes: steep ground is never rated safe, level ground is rated where it is known well."""

import math

import pytest
import torch
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.sim.exact.sensors import DepthCamera, Lidar

SENSORS = {
    "camera": (DepthCamera(120, 90).directions, 8.0, 0.9, 0.5),
    "8 rings": (Lidar(rings=8).directions, 20.0, 0.7, 0.0),
    "16 rings": (Lidar(rings=16).directions, 20.0, 0.7, 0.0),
    "32 rings": (Lidar(rings=32).directions, 20.0, 0.7, 0.0),
}


def turned_pose(height: float, pitch: float, yaw: float = 0.3) -> Tensor:
    """A sensor over the origin, pitched down by `pitch` and turned by `yaw` [rad]: (1, 4, 4)."""
    c, s, d, n = math.cos(pitch), math.sin(pitch), math.cos(yaw), math.sin(yaw)
    rows = [[d * c, -n, d * s, 0.0], [n * c, d, n * s, 0.0], [-s, 0.0, c, height], [0.0, 0.0, 0.0, 1.0]]
    return torch.tensor([rows], dtype=torch.float64)


def points_on_plane(directions, T, angle, heading, reach, noise, generator):
    """Points (1, N, 3) in the sensor frame on a plane through the origin that falls by `angle` along `heading`."""
    gx, gy = (-math.tan(angle) * part for part in (math.cos(heading), math.sin(heading)))
    rays = directions.double() @ T[0, :3, :3].T
    distance = -T[0, 2, 3] / (rays[:, 2] - gx * rays[:, 0] - gy * rays[:, 1])
    hit = (distance > 0) & (distance < reach)
    distance = distance * (1 + noise * torch.randn(len(distance), generator=generator, dtype=torch.float64))
    return torch.where(hit[:, None], directions.double() * distance[:, None], torch.nan)[None].float()


def map_of(resolution: float, length: float = 8.0) -> ElevationMap:
    grid = GridConfig(resolution=resolution, length_x=length, length_y=length)
    return ElevationMap(ElevationMapConfig(grid=grid, overlap=None))


@pytest.mark.slow(1)
@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("resolution", [0.04, 0.1])
@pytest.mark.parametrize("angle", [0, 20, 45, 60])
@pytest.mark.parametrize("name", SENSORS)
def test_planes_seen_by_a_sensor(name, angle, resolution, noise):
    """At most 1 % of the known cells are rated safe where the slope is beyond the critical one of 40 degrees."""
    directions, reach, height, pitch = SENSORS[name]
    generator, known, rated, safe = torch.Generator().manual_seed(0), 0, 0, 0
    for heading in (0.0, 0.5, 1.57):
        emap, T = map_of(resolution), turned_pose(height, pitch)
        points = points_on_plane(directions, T, math.radians(angle), heading, reach, noise, generator)
        emap.update(points, T, T, dt=0.1)
        layer = emap.layer("traversability")
        known, rated = known + int(emap.validity.sum()), rated + int(layer.isfinite().sum())
        safe += int((layer > 0.5).sum())
    assert known > 500
    if angle > 40:
        assert safe <= 0.01 * known
    elif angle == 0 and noise == 0:
        assert safe == rated
        assert rated >= {"camera": 0.8, "8 rings": 0.0, "16 rings": 0.15, "32 rings": 0.35}[name] * known


@pytest.mark.parametrize("share", [0.01, 0.05, 0.2])
@pytest.mark.parametrize("angle", [0, 45, 60])
def test_random_cells_of_a_plane(angle, share):
    """Cells at random places, each hit at a random point."""
    generator = torch.Generator().manual_seed(1)
    emap = map_of(0.04)
    centers = emap.cell_centers()
    xy = centers + (torch.rand(centers.shape, generator=generator) - 0.5) * 0.04
    picked = torch.rand(centers.shape[:-1], generator=generator) < share
    heights = -math.tan(math.radians(angle)) * (0.8 * xy[..., 0] + 0.6 * xy[..., 1])
    T = turned_pose(0.0, 0.0, 0.0)
    # From below, as no ray then passes over the plane.
    points = torch.cat([xy, heights[..., None]], -1)[picked][None]
    emap.update(points, T, None, dt=0.1, variance=torch.full(points.shape[:-1], 1e-4))
    known, layer = emap.validity, emap.layer("traversability")
    if angle == 0:
        assert (layer[layer.isfinite()] > 0.5).all()
        assert layer.isfinite().sum() > {0.01: 0.0, 0.05: 0.08, 0.2: 0.6}[share] * known.sum()
    else:
        assert (layer > 0.5).sum() <= 0.01 * known.sum()
