"""Terrain shapes in closed form, as functions of position, difficulty and random numbers, as in training curricula.

Each function takes positions x, y (B, M) [m] in the tile frame, `difficulty` (B, 1) from 0 to 1 and a table `random`
(B, TABLE * TABLE) of numbers from 0 to 1, and returns heights (B, M) [m]. The robot starts on a flat platform at z = 0
around the origin. Platforms and rings are square, with the distance r = max(|x|, |y|) from the start.

| kind | from difficulty 0 to 1 | fixed | platform |
|---|---|---|---|
| flat | | | everywhere |
| slope | gradient 0 to 0.4 (*) | at random a pyramid or a bowl | 2.01 m |
| stairs_up | steps 0.05 to 0.23 m high (*), climbing towards the platform | 0.3 m deep (*) | 3.01 m |
| stairs_down | the same, descending towards the platform | 0.3 m deep (*) | 3.01 m |
| boxes | tops within +-0.05 to +-0.2 m (*) | squares of 0.45 m (*) | 2.01 m |
| stepping_stones | 1 to 0.25 m wide, 0.05 to 0.3 m apart, tops within +-0 to +-0.05 m | holes 1 m deep | 2.01 m |
| gaps | 0.1 to 0.8 m wide | 1 m deep, 1 m of ground between | 3.01 m |
| rough | within +-0.01 to +-0.05 m (**) | a height every 0.2 m (**), bilinear between | 2 m |
| rails | 0.05 to 0.25 m high | 0.06 m thick, 0.8 m apart | 3.01 m |

(*) as in Isaac Lab's rough terrains; platforms are 1 cm wider, so that no edge lies on a sample of a 4 cm field.
(**) the hardest level as in legged_gym. All other values are chosen.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

TABLE = 64  # numbers along each side of a tile's table; random patterns repeat after this many lattice cells
_SMALL, _LARGE = 1.005, 1.505  # [m] half the side of a platform
_STEP_DEPTH = 0.3  # [m] of stairs
_BOX = 0.45  # [m] side of a box
_BOX_SHIFT = 0.013  # [m] moves the edges of boxes off the samples of a field
_HOLE = 1.0  # [m] depth of gaps, and between stepping stones
_STRIP = 1.0  # [m] of ground between gaps
_BUMP = 0.2  # [m] between the heights of rough ground
_FLAT_BUMPS = 5  # lattice points from the origin within which rough ground is flat
_RAIL, _RAIL_DISTANCE = 0.06, 0.8  # [m] thickness, and distance from one rail to the next

_Shape = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]


def _square_distance(x: Tensor, y: Tensor) -> Tensor:
    """Return the distance from the start, r = max(|x|, |y|)."""
    return torch.maximum(x.abs(), y.abs())


def _interpolate(low: float, high: float, difficulty: Tensor) -> Tensor:
    """Return the value at a difficulty, from `low` at 0 to `high` at 1."""
    return low + (high - low) * difficulty


def _look_up(random: Tensor, i: Tensor, j: Tensor, channel: int = 0) -> Tensor:
    """Return the random number from -1 to 1 of lattice cell (i, j), integers (B, M)."""
    # All channels share a table, shifted by more cells than a tile has.
    row, column = (i + 21 * channel).remainder(TABLE).long(), j.remainder(TABLE).long()
    return 2 * random.gather(1, row * TABLE + column) - 1


def flat(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return flat ground."""
    return torch.zeros_like(x)


def slope(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return the slopes of a pyramid or of a bowl around the platform."""
    up = torch.where(random[:, :1] < 0.5, -1.0, 1.0)
    return up * _interpolate(0.0, 0.4, difficulty) * (_square_distance(x, y) - _SMALL).clamp(min=0)


def stairs_down(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return stairs that descend towards the platform from all sides."""
    count = torch.ceil((_square_distance(x, y) - _LARGE) / _STEP_DEPTH).clamp(min=0)
    return _interpolate(0.05, 0.23, difficulty) * count


def stairs_up(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return stairs that climb towards the platform from all sides."""
    return 0.0 - stairs_down(x, y, difficulty, random)


def boxes(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return square boxes of random heights."""
    i, j = (torch.floor((a - _BOX_SHIFT) / _BOX) for a in (x, y))
    top = _interpolate(0.05, 0.2, difficulty) * _look_up(random, i, j)
    return torch.where(_square_distance(x, y) < _SMALL, 0.0, top)


def stepping_stones(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return stones of random heights, displaced by up to a quarter of the distance between them, with holes around."""
    width, distance = _interpolate(1.0, 0.25, difficulty), _interpolate(0.05, 0.3, difficulty)
    i, j = (torch.round(a / (width + distance)) for a in (x, y))
    x_off, y_off = (k * (width + distance) + distance / 4 * _look_up(random, i, j, c) for c, k in enumerate((i, j)))
    top = 0.05 * difficulty * _look_up(random, i, j, 2)
    z = torch.where(_square_distance(x - x_off, y - y_off) < width / 2, top, -_HOLE)
    return torch.where(_square_distance(x, y) < _SMALL, 0.0, z)


def gaps(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return square moats around the platform."""
    width, beyond = _interpolate(0.1, 0.8, difficulty), _square_distance(x, y) - _LARGE
    return torch.where((beyond >= 0) & (beyond.remainder(width + _STRIP) < width), -_HOLE, 0.0).to(x.dtype)


def rough(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return random heights on a lattice, bilinear between its points."""
    i, j = (torch.floor(a / _BUMP) for a in (x, y))
    u, v = x / _BUMP - i, y / _BUMP - j
    a, b, c, d = (_bump(random, i + di, j + dj) for di, dj in ((0, 0), (1, 0), (0, 1), (1, 1)))
    z = (a * (1 - u) + b * u) * (1 - v) + (c * (1 - u) + d * u) * v
    return _interpolate(0.01, 0.05, difficulty) * z


def _bump(random: Tensor, i: Tensor, j: Tensor) -> Tensor:
    return torch.where(_square_distance(i, j) <= _FLAT_BUMPS, 0.0, _look_up(random, i, j))


def rails(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return square rings of bars around the platform."""
    beyond = _square_distance(x, y) - _LARGE
    is_rail = (beyond >= 0) & (beyond.remainder(_RAIL_DISTANCE) < _RAIL)
    return torch.where(is_rail, _interpolate(0.05, 0.25, difficulty), 0.0)


SHAPES: dict[str, _Shape] = {
    "flat": flat,
    "slope": slope,
    "stairs_up": stairs_up,
    "stairs_down": stairs_down,
    "boxes": boxes,
    "stepping_stones": stepping_stones,
    "gaps": gaps,
    "rough": rough,
    "rails": rails,
}
