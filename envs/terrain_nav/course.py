"""Where TerrainNav takes place: tiles of rough ground with blocks, pits and steps, and routes across them.

Obstacles stand on a jittered lattice. They never meet, most leave room for a robot between them, and few routes can be
walked straight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from envs.terrain_nav.config import CourseConfig
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.pipeline import rate_surface
from torchelev.sim import HeightField

BORDER = 1.0  # [m] at a tile's rim where no route begins or ends


@dataclass(frozen=True)
class Course:
    """Tiles and, for each, pairs of start and goal."""

    field: HeightField
    traversability: HeightField  # of the true ground, rated as a map rates it
    starts: Tensor  # (K, R, 2) [m] tile frame
    goals: Tensor  # (K, R, 2) [m]


def make_course(cfg: CourseConfig, device: torch.device | str = "cpu") -> Course:
    """Make the tiles and routes of a config; the same seed makes the same course."""
    generator = torch.Generator().manual_seed(cfg.seed)
    heights = torch.stack([_tile(cfg, generator) for _ in range(cfg.num_tiles)])
    starts, goals = _routes(heights, cfg, generator)
    field = HeightField(heights.to(device), cfg.resolution)
    return Course(field, HeightField(_rate(field), cfg.resolution), starts.to(device), goals.to(device))


def _rate(field: HeightField) -> Tensor:
    """Return the analytic traversability (K, H, W) of the ground."""
    size = [n * field.resolution for n in field.heights.shape[1:]]
    grid = GridConfig(resolution=field.resolution, length_x=size[0], length_y=size[1])
    emap = ElevationMap(ElevationMapConfig(grid=grid), field.num_tiles, field.device)
    known = emap.state._replace(elevation=field.heights, validity=torch.ones_like(emap.state.validity))
    return rate_surface(known, emap.cfg).traversability


def _axis(cfg: CourseConfig) -> Tensor:
    count = round(cfg.length / cfg.resolution) + 1
    return (torch.arange(count) - (count - 1) / 2) * cfg.resolution


def _uniform(generator: torch.Generator, limits: tuple[float, float], *shape: int) -> Tensor:
    return limits[0] + (limits[1] - limits[0]) * torch.rand(*shape, generator=generator)


def _tile(cfg: CourseConfig, generator: torch.Generator) -> Tensor:
    """Return the heights (n, n) [m] of one tile."""
    axis = _axis(cfg)
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    ground = _waves(x, y, cfg.roughness, generator)
    reach = cfg.length / 2 - BORDER
    count = int(2 * reach / cfg.spacing) + 1
    lattice = (torch.arange(count) - (count - 1) / 2) * cfg.spacing
    offset = _uniform(generator, (-0.5, 0.5), 2) * cfg.spacing  # the lattice lies elsewhere in each tile
    for cx in (lattice + offset[0]).tolist():
        for cy in (lattice + offset[1]).tolist():
            ground = ground + _obstacle(x - cx, y - cy, cfg, generator)
    return ground


def _waves(x: Tensor, y: Tensor, amplitude: float, generator: torch.Generator) -> Tensor:
    """Return a sum of four sines of 1 to 4 m length."""
    z = torch.zeros_like(x)
    for length, heading, phase in torch.rand(4, 3, generator=generator).tolist():
        k, angle = 2 * math.pi / (1 + 3 * length), 2 * math.pi * heading
        z = z + amplitude / 2 * torch.sin(k * (x * math.cos(angle) + y * math.sin(angle)) + 2 * math.pi * phase)
    return z


def _obstacle(x: Tensor, y: Tensor, cfg: CourseConfig, generator: torch.Generator) -> Tensor:
    """Return what a site at the origin adds to the ground: a turned rectangle, up or down, or nothing."""
    kind, u, heading = torch.rand(3, generator=generator).tolist()
    jitter = _uniform(generator, (-cfg.jitter, cfg.jitter), 2).tolist()
    diagonal = float(_uniform(generator, cfg.half_diagonal, 1))
    corner = float(_uniform(generator, (0.5, 1.07), 1))  # [rad] the rectangle's diagonal: 30 to 60 degrees
    cos, sin = math.cos(math.pi * heading), math.sin(math.pi * heading)
    x, y = x - jitter[0], y - jitter[1]
    along, across = cos * x + sin * y, cos * y - sin * x
    inside = (along.abs() <= diagonal * math.cos(corner)) & (across.abs() <= diagonal * math.sin(corner))
    blocks, pits, steps = cfg.shares
    low, high, sign = (*cfg.block_height, 1.0) if kind < blocks else (*cfg.pit_depth, -1.0)
    if kind >= blocks + pits:
        low, high, sign = *cfg.step_height, float(kind < blocks + pits + steps)
    return inside * (sign * (low + (high - low) * u))


def _routes(heights: Tensor, cfg: CourseConfig, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return starts and goals (K, R, 2) [m]: level ground around both, and the wanted distance between them."""
    radius = round(cfg.clearance / cfg.resolution)
    window = 2 * radius + 1
    high = F.max_pool2d(heights[:, None], window, 1, radius)[:, 0]
    low = -F.max_pool2d(-heights[:, None], window, 1, radius)[:, 0]
    axis = _axis(cfg)
    inner = (axis.abs() <= cfg.length / 2 - BORDER).float()
    clear = ((high - low) < 0.06 + 4 * cfg.roughness).float() * inner[:, None] * inner
    pairs = [_pick_routes(tile, axis, cfg, generator) for tile in clear]
    return torch.stack([start for start, _ in pairs]), torch.stack([goal for _, goal in pairs])


def _pick_routes(clear: Tensor, axis: Tensor, cfg: CourseConfig, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    tries = 64 * cfg.num_routes
    picks = torch.multinomial(clear.flatten(), 2 * tries, replacement=True, generator=generator)
    places = torch.stack([axis[picks // len(axis)], axis[picks % len(axis)]], -1).view(2, tries, 2)
    distance = torch.linalg.vector_norm(places[0] - places[1], dim=-1)
    good = torch.nonzero((distance >= cfg.distance[0]) & (distance <= cfg.distance[1]))[:, 0]
    if not len(good):
        raise RuntimeError("course: no route of this distance has level ground at both ends; lower shares or clearance")
    chosen = good[torch.arange(cfg.num_routes) % len(good)]
    return places[0, chosen], places[1, chosen]
