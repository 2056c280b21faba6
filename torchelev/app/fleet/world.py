"""The terrain that a fleet explores: tiles of many kinds side by side, hills, and walls and blocks to walk around."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.sim import HeightField, terrain_grid
from torchelev.sim.steps import find_steps
from torchelev.sim.waves import Waves

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_RESOLUTION = 0.05  # [m] between the samples of the terrain
_TILE = 10.0  # [m] side of a tile
_MARGIN = 8.0  # [m] of terrain around the area, which robots see but do not enter
_KINDS = ("slope", "stairs_up", "stairs_down", "boxes", "rough", "rails", "slope", "rough")
_DIFFICULTY = (0.2, 0.45)  # of the tiles: steps of 9 to 14 cm, slopes of 5 to 10 degrees
_CAMP_RIM = 3.0  # [m] around the camp, over which its flat ground becomes terrain
_AREA_PER_OBSTACLE = 45.0  # [m^2]
_WALL, _BLOCK = (4.0, 0.4), (1.8, 1.8)  # [m] largest length and width
_OBSTACLE_HEIGHT = (0.4, 0.6)  # [m]: too high to climb, low enough to see what lies on top


class World:
    """A square area around the map frame's origin, with a camp of level ground in its middle.

    Args:
        size: side of the area [m].
        camp_radius: within which the ground is level and free [m].
        seed: the same seed makes the same world.
    """

    def __init__(self, size: float, camp_radius: float, seed: int) -> None:
        self.size = size
        generator = torch.Generator().manual_seed(seed)
        num_samples = 2 * math.ceil((size / 2 + _MARGIN) / _RESOLUTION) + 1
        axis = (torch.arange(num_samples) - num_samples // 2) * _RESOLUTION
        x, y = axis[:, None], axis[None, :]
        rise = ((torch.hypot(x, y) - camp_radius) / _CAMP_RIM).clamp(0, 1)
        heights = rise * (_join_tiles(num_samples, seed) + _hills(generator)(x, y))
        heights += _obstacles(axis, size, camp_radius + _CAMP_RIM, generator)
        self.field = HeightField(heights[None], _RESOLUTION)

    def truth(self, xy: Float[Tensor, "*M 2"]) -> Float[Tensor, "*M"]:
        """Return the height of the ground [m] at xy [m]."""
        tile = torch.zeros(1, dtype=torch.int64)
        return self.field.height(tile, xy.reshape(1, -1, 2)).view(xy.shape[:-1])

    def find_steps(self, xy: Float[Tensor, "*M 2"], resolution: float) -> Bool[Tensor, "*M"]:
        """Find the cells, given by centres [m], in or next to which the ground rises by more than 8 cm."""
        return find_steps(self.truth, xy, resolution, 0.08)


def _join_tiles(num_samples: int, seed: int) -> Float[Tensor, "N N"]:
    """Return the heights of tiles side by side, whose rims meet at about the same height."""
    per_side, samples = math.ceil(num_samples * _RESOLUTION / _TILE), round(_TILE / _RESOLUTION)
    num_levels = math.ceil(per_side**2 / len(_KINDS))
    grid = terrain_grid(_KINDS, num_levels, difficulty=_DIFFICULTY, length=_TILE, resolution=_RESOLUTION, seed=seed)
    heights = grid.field.heights[:, :-1, :-1]
    is_ringed = torch.tensor([kind in ("slope", "stairs_up", "stairs_down") for kind in grid.kind])
    heights = heights - torch.where(is_ringed, heights[:, 0, 0], 0.0)[:, None, None]  # start at the rim, not the middle
    order = torch.randperm(len(heights), generator=torch.Generator().manual_seed(seed))[: per_side**2]
    rows = heights[order].view(per_side, per_side, samples, samples)
    return rows.transpose(1, 2).reshape(per_side * samples, -1)[:num_samples, :num_samples]


def _hills(generator: torch.Generator) -> Waves:
    """Draw long waves: hills of about a metre."""
    length, heading, phase = torch.rand(3, 4, generator=generator).double()
    turn = 2 * math.pi
    return Waves([0.4] * 4, (25 + 25 * length).tolist(), (turn * heading).tolist(), (turn * phase).tolist())


def _obstacles(axis: Tensor, size: float, keep_out: float, generator: torch.Generator) -> Float[Tensor, "N N"]:
    """Return what walls and blocks at random places add to the ground [m]."""
    added = torch.zeros(len(axis), len(axis))
    for _ in range(round(size**2 / _AREA_PER_OBSTACLE)):
        kind, long, wide, tall, heading, *place = torch.rand(7, generator=generator).tolist()
        x, y = ((u - 0.5) * (size - 4.0) for u in place)
        length, width = _WALL if kind < 0.4 else _BLOCK
        length, width = length * (0.5 + long / 2), width * (1.0 if kind < 0.4 else 0.4 + 0.6 * wide)
        if math.hypot(x, y) > keep_out + length / 2:
            low, high = _OBSTACLE_HEIGHT
            _raise(added, axis, (x, y), math.pi * heading, (length, width), low + (high - low) * tall)
    return added


def _raise(
    added: Tensor, axis: Tensor, place: tuple[float, float], heading: float, sides: tuple[float, float], height: float
) -> None:
    """Raise the ground in a rectangle to `height` [m], in place."""
    radius = math.hypot(*sides) / 2
    i, j = (slice(*torch.searchsorted(axis, torch.tensor([c - radius, c + radius])).tolist()) for c in place)
    x, y = axis[i, None] - place[0], axis[None, j] - place[1]
    along = math.cos(heading) * x + math.sin(heading) * y
    across = math.cos(heading) * y - math.sin(heading) * x
    is_inside = (along.abs() <= sides[0] / 2) & (across.abs() <= sides[1] / 2)
    added[i, j] = torch.maximum(added[i, j], height * is_inside)


def make_camp(num_robots: int, spacing: float) -> Float[Tensor, "B 2"]:
    """Return the places (B, 2) [m] of robots on a square lattice around the origin, float64."""
    per_side = math.ceil(math.sqrt(num_robots))
    axis = (torch.arange(per_side, dtype=torch.float64) - (per_side - 1) / 2) * spacing
    return torch.cartesian_prod(axis, axis)[:num_robots]
