"""An obstacle course: tiles of rough ground with blocks, pits and steps, and routes across them.

Obstacles stand on a jittered lattice. They never overlap, most leave room for a robot between them, and few routes can
be walked in a straight line.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.errors import require
from torchelev.sim.terrains.covers import CoversConfig, Rooms, make_rooms
from torchelev.sim.terrains.heightfield import HeightField
from torchelev.sim.terrains.structures import Structures
from torchelev.sim.waves import even_waves

if TYPE_CHECKING:
    from jaxtyping import Float

_BORDER = 1.0  # [m] along a tile's rim in which no route starts or ends


@dataclass(frozen=True, kw_only=True)
class CourseConfig:
    """An obstacle course: square tiles with obstacles to walk around, and some that can be walked over."""

    num_tiles: int = 64  #: more tiles make the course more varied, and take longer to make
    length: float = 12.0  #: [m] side of a tile
    resolution: float = 0.05  #: [m] between the samples of the height field
    seed: int = 0  #: the same seed makes the same course
    spacing: float = 2.0  #: [m] between the sites of obstacles; must leave a gap between the largest ones
    jitter: float = 0.15  #: [m] largest displacement of a site from its lattice, along x and y each
    half_diagonal: tuple[float, float] = (0.5, 0.75)  #: [m] half the diagonal of an obstacle's rectangle, (min, max)
    block_height: tuple[float, float] = (0.3, 0.7)  #: [m] (min, max); too high to climb
    pit_depth: tuple[float, float] = (0.5, 1.0)  #: [m] (min, max); deep enough to fall into
    step_height: tuple[float, float] = (0.06, 0.15)  #: [m] (min, max); low enough to walk over
    shares: tuple[float, float, float] = (0.4, 0.3, 0.2)  #: fractions of blocks, pits and steps; other sites stay free
    roughness: float = 0.03  #: [m] amplitude of the ground's waves
    distance: tuple[float, float] = (4.0, 6.0)  #: [m] from start to goal, (min, max)
    clearance: float = 0.5  #: [m] radius of the level ground around starts and goals
    num_routes: int = 256  #: pairs of start and goal on each tile
    #: walls with gates, tables and beams in place of all other obstacles; None for none
    covers: CoversConfig | None = None

    def __post_init__(self) -> None:
        gap = self.spacing - 2 * (self.half_diagonal[1] + self.jitter)
        require(gap >= 0, "CourseConfig.spacing", "must leave a gap between obstacles", f"{gap:.2f} m", "raise it")
        total = sum(self.shares)
        require(total <= 1, "CourseConfig.shares", "must sum to at most 1", self.shares, "lower one of them")
        require(self.num_tiles >= 1, "CourseConfig.num_tiles", "must be positive", self.num_tiles, "give at least one")


@dataclass(frozen=True, eq=False)
class Course:
    """K tiles, and R pairs of start and goal on each."""

    field: HeightField  #: the ground
    starts: Float[Tensor, "K R 2"]  #: [m] tile frame
    goals: Float[Tensor, "K R 2"]  #: [m] tile frame
    #: boxes over the ground; None without `covers`
    structures: Structures | None = dataclasses.field(default=None, kw_only=True)


def make_course(cfg: CourseConfig, device: torch.device | str = "cpu") -> Course:
    """Make the tiles and routes of a config.

    Args:
        cfg: The settings; the same settings make the same course on every device.
        device: Where the course is stored.

    Raises:
        RuntimeError: No pair of level places lies at the wanted distance.
    """
    generator = torch.Generator().manual_seed(cfg.seed)
    if cfg.covers is not None:
        return _make_covered(cfg, cfg.covers, generator, device)
    heights = torch.stack([_make_tile(cfg, generator) for _ in range(cfg.num_tiles)])
    starts, goals = _draw_routes(heights, cfg, generator)
    return Course(HeightField(heights.to(device), cfg.resolution), starts.to(device), goals.to(device))


def _make_covered(
    cfg: CourseConfig, covers: CoversConfig, generator: torch.Generator, device: torch.device | str
) -> Course:
    """Make a course whose tiles are rooms, and whose routes lead from room to room."""
    axis = _axis(cfg)
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    rooms = [
        make_rooms(even_waves(generator, cfg.roughness)(x, y), axis, covers, generator) for _ in range(cfg.num_tiles)
    ]
    starts, goals = _draw_routes(torch.stack([tile.obstacles for tile in rooms]), cfg, generator, rooms)
    field = HeightField(torch.stack([tile.heights for tile in rooms]).to(device), cfg.resolution)
    structures = Structures.of_tiles([tile.parts for tile in rooms], device)
    return Course(field, starts.to(device), goals.to(device), structures=structures)


def _axis(cfg: CourseConfig) -> Tensor:
    """Return the coordinates [m] of a tile's samples along x or y."""
    count = round(cfg.length / cfg.resolution) + 1
    return (torch.arange(count) - (count - 1) / 2) * cfg.resolution


def _uniform(generator: torch.Generator, limits: tuple[float, float], *shape: int) -> Tensor:
    return limits[0] + (limits[1] - limits[0]) * torch.rand(*shape, generator=generator)


def _make_tile(cfg: CourseConfig, generator: torch.Generator) -> Tensor:
    """Return the heights (n, n) [m] of one tile."""
    axis = _axis(cfg)
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    ground = even_waves(generator, cfg.roughness)(x, y)
    reach = cfg.length / 2 - _BORDER
    count = int(2 * reach / cfg.spacing) + 1
    lattice = (torch.arange(count) - (count - 1) / 2) * cfg.spacing
    offset = _uniform(generator, (-0.5, 0.5), 2) * cfg.spacing  # each tile shifts the lattice
    for site_x in (lattice + offset[0]).tolist():
        for site_y in (lattice + offset[1]).tolist():
            ground = ground + _obstacle(x - site_x, y - site_y, cfg, generator)
    return ground


def _obstacle(x: Tensor, y: Tensor, cfg: CourseConfig, generator: torch.Generator) -> Tensor:
    """Return the height [m] that the site at the origin adds: a rotated rectangle, up or down, or nothing."""
    kind, u, heading = torch.rand(3, generator=generator).tolist()
    jitter = _uniform(generator, (-cfg.jitter, cfg.jitter), 2).tolist()
    diagonal = float(_uniform(generator, cfg.half_diagonal, 1))
    corner = float(_uniform(generator, (0.5, 1.07), 1))  # [rad] angle of the rectangle's diagonal: 30 to 60 degrees
    cos, sin = math.cos(math.pi * heading), math.sin(math.pi * heading)
    x, y = x - jitter[0], y - jitter[1]
    along, across = cos * x + sin * y, cos * y - sin * x
    inside = (along.abs() <= diagonal * math.cos(corner)) & (across.abs() <= diagonal * math.sin(corner))
    blocks, pits, steps = cfg.shares
    low, high, sign = (*cfg.block_height, 1.0) if kind < blocks else (*cfg.pit_depth, -1.0)
    if kind >= blocks + pits:
        low, high, sign = *cfg.step_height, float(kind < blocks + pits + steps)
    return inside * (sign * (low + (high - low) * u))


def _draw_routes(
    heights: Tensor, cfg: CourseConfig, generator: torch.Generator, rooms: Sequence[Rooms | None] | None = None
) -> tuple[Tensor, Tensor]:
    """Return starts and goals (K, R, 2) [m] on level ground, at the wanted distance, and in different rooms."""
    radius = round(cfg.clearance / cfg.resolution)
    window = 2 * radius + 1
    highest = F.max_pool2d(heights[:, None], window, 1, radius)[:, 0]
    lowest = -F.max_pool2d(-heights[:, None], window, 1, radius)[:, 0]
    axis = _axis(cfg)
    inner = (axis.abs() <= cfg.length / 2 - _BORDER).float()
    level = ((highest - lowest) < 0.06 + 4 * cfg.roughness).float() * inner[:, None] * inner
    tiles = zip(level, rooms or [None] * len(level), strict=True)
    pairs = [_draw_pairs(tile, axis, cfg, generator, own) for tile, own in tiles]
    return torch.stack([start for start, _ in pairs]), torch.stack([goal for _, goal in pairs])


def _draw_pairs(
    level: Tensor, axis: Tensor, cfg: CourseConfig, generator: torch.Generator, rooms: Rooms | None
) -> tuple[Tensor, Tensor]:
    """Return starts and goals (R, 2) [m] on one tile; `level` (n, n) is 1 where a route may start or end."""
    tries = 64 * cfg.num_routes
    picks = torch.multinomial(level.flatten(), 2 * tries, replacement=True, generator=generator)
    places = torch.stack([axis[picks // len(axis)], axis[picks % len(axis)]], -1).view(2, tries, 2)
    distance = torch.linalg.vector_norm(places[0] - places[1], dim=-1)
    fits = (distance >= cfg.distance[0]) & (distance <= cfg.distance[1])
    if rooms is not None:
        start, goal = torch.bucketize(places[..., 0].contiguous(), rooms.walls)
        fits = fits & (start != goal)
    good = torch.nonzero(fits)[:, 0]
    if not len(good):
        raise RuntimeError("course: no route of this distance has level ground at both ends; lower shares or clearance")
    chosen = good[torch.arange(cfg.num_routes) % len(good)]
    return places[0, chosen], places[1, chosen]
