"""Rooms on a course: walls across a tile with gates in them, tables and beams, some too low to pass under."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import require, require_positive
from torchelev.sim.terrains.parts import Part, beam, placed, table

if TYPE_CHECKING:
    from jaxtyping import Float

_TABLE = (1.2, 0.8)  # [m] length and width
_BEAM = 1.6  # [m] length


@dataclass(frozen=True, kw_only=True)
class CoversConfig:
    """Walls along y, gates through them that are low or high, and tables and beams between the walls.

    Gates stand in pairs, of which one is low and one is high: there is always a way round.

    Raises:
        ValueError: A setting is out of range.
    """

    wall_spacing: float = 4.0  #: [m] between walls
    wall_height: float = 1.4  #: [m] of the walls over the ground
    wall_thickness: tuple[float, float] = (0.2, 0.4)  #: [m] (min, max)
    gate_spacing: float = 2.0  #: [m] between the middles of gates
    gate_width: tuple[float, float] = (1.2, 1.5)  #: [m] (min, max)
    low: tuple[float, float] = (0.35, 0.52)  #: [m] (min, max) free height below what the robot does not fit under
    high: tuple[float, float] = (0.72, 1.1)  #: [m] (min, max) free height below what it fits under
    low_share: float = 0.5  #: fraction of the tables and beams that are low
    table_share: float = 0.35  #: fraction of the places in rooms with a table
    beam_share: float = 0.35  #: fraction of the places in rooms with a beam
    place_spacing: float = 3.0  #: [m] along y between the places of tables and beams

    def __post_init__(self) -> None:
        lengths = ("wall_spacing", "wall_height", "gate_spacing", "place_spacing")
        require_positive(**{f"CoversConfig.{name}": getattr(self, name) for name in lengths})
        is_ordered = 0 < self.low[0] <= self.low[1] <= self.high[0] <= self.high[1] < self.wall_height
        actual, hint = (self.low, self.high, self.wall_height), "lower them, or raise the wall"
        require(is_ordered, "CoversConfig.low, high, wall_height", "must be ordered", actual, hint)
        fits, rule = self.gate_width[1] < self.gate_spacing, "must be below gate_spacing"
        require(fits, "CoversConfig.gate_width", rule, self.gate_width, "make gates narrower")
        shares = (self.table_share, self.beam_share)
        fits = min(shares) >= 0 and sum(shares) <= 1
        hint = "lower one of them"
        require(fits, "CoversConfig.table_share, beam_share", "must sum to at most 1", shares, hint)


class Rooms(NamedTuple):
    """One tile."""

    heights: Float[Tensor, "n n"]  #: [m] ground with walls
    obstacles: Float[Tensor, "n n"]  #: [m] the same, raised below all parts, so that no route begins or ends there
    walls: Float[Tensor, "W"]  #: [m] x of the middles of the walls
    parts: list[Part]  #: lintels, tables and beams


def make_rooms(
    ground: Float[Tensor, "n n"], axis: Float[Tensor, "n"], cfg: CoversConfig, rng: torch.Generator
) -> Rooms:
    """Put walls and structures on one tile.

    Args:
        ground: Heights without them [m].
        axis: Coordinates of the samples along x and y [m].
        cfg: The settings.
        rng: Source of all draws.
    """
    half = float(axis[-1])
    count = math.floor(2 * half / cfg.wall_spacing - 0.5)
    walls = (torch.arange(count) - (count - 1) / 2) * cfg.wall_spacing
    heights, parts = ground.clone(), list[Part]()
    for x in walls.tolist():
        parts += _build_wall(x, heights, ground, axis, cfg, rng)
    for x in [*(walls - cfg.wall_spacing / 2).tolist(), float(walls[-1]) + cfg.wall_spacing / 2]:
        parts += _furnish(x, ground, axis, cfg, rng)
    return Rooms(heights, _raise_below(parts, heights, axis), walls, parts)


def _build_wall(
    x: float, heights: Tensor, ground: Tensor, axis: Tensor, cfg: CoversConfig, rng: torch.Generator
) -> list[Part]:
    """Raise a wall at `x` [m] in `heights` and return the lintels of its gates."""
    thickness = _draw(rng, cfg.wall_thickness)
    is_wall = ((axis - x).abs() <= thickness / 2)[:, None] & torch.ones_like(heights, dtype=torch.bool)
    first, lintels = _draw(rng, (-0.5, 0.5)) * cfg.gate_spacing, list[Part]()
    count = math.floor((float(axis[-1]) - 1.0) / cfg.gate_spacing)
    first_is_low = False
    for k in range(-count, count + 1):
        first_is_low = _draw(rng, (0.0, 1.0)) < 0.5 if (k + count) % 2 == 0 else not first_is_low
        y, width = first + k * cfg.gate_spacing, _draw(rng, cfg.gate_width)
        free = _draw(rng, cfg.low if first_is_low else cfg.high)
        is_wall &= ~((axis - y).abs() <= width / 2)[None]
        lintel = beam(free, width, thickness, cfg.wall_height - free)
        lintels += placed(lintel, x, y, _height(ground, axis, x, y))
    heights[is_wall] += cfg.wall_height
    return lintels


def _furnish(x: float, ground: Tensor, axis: Tensor, cfg: CoversConfig, rng: torch.Generator) -> list[Part]:
    """Return the tables and beams of the room whose middle is at `x` [m]."""
    count = math.floor(float(axis[-1]) / cfg.place_spacing)
    shift, parts = _draw(rng, (-0.5, 0.5)) * cfg.place_spacing, list[Part]()
    for k in range(-count + 1, count):
        kind, is_low, turn, u = torch.rand(4, generator=rng).tolist()
        low, high = cfg.low if is_low < cfg.low_share else cfg.high
        free, y = low + (high - low) * u, shift + k * cfg.place_spacing
        if kind < cfg.table_share:
            made = table(free, *_TABLE)
        elif kind < cfg.table_share + cfg.beam_share:
            made = beam(free, _BEAM)
        else:
            continue
        parts += placed(made, x, y, _height(ground, axis, x, y), math.pi * turn)
    return parts


def _draw(rng: torch.Generator, limits: tuple[float, float]) -> float:
    return limits[0] + (limits[1] - limits[0]) * float(torch.rand((), generator=rng))


def _height(ground: Tensor, axis: Tensor, x: float, y: float) -> float:
    """Return the height [m] of the sample nearest to a place."""
    i, j = (int((axis - value).abs().argmin()) for value in (x, y))
    return float(ground[i, j])


def _raise_below(parts: list[Part], heights: Tensor, axis: Tensor) -> Tensor:
    """Return heights raised by a metre below and in all parts."""
    raised = heights.clone()
    for (x, y, _), (a, b, _), yaw in parts:
        dx, dy = (axis - x)[:, None], (axis - y)[None]
        cos, sin = math.cos(yaw), math.sin(yaw)
        covers = ((cos * dx + sin * dy).abs() <= a) & ((cos * dy - sin * dx).abs() <= b)
        raised[covers] = heights[covers] + 1.0
    return raised
