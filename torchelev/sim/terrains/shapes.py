"""Ground in closed form, as functions of place, difficulty and chance: the same that curricula in simulators have.

Each function takes places x, y (B, M) [m] in the tile's frame, `difficulty` (B, 1) from 0 to 1 and `random`
(B, TABLE * TABLE) from 0 to 1, and returns heights (B, M) [m]. The robot's start is a flat platform at z = 0 around the
origin. Everything is built of squares, so distances from the start are r = max(|x|, |y|).

| kind | from difficulty 0 to 1 | fixed | platform |
|---|---|---|---|
| flat | | | everywhere |
| slope | gradient 0 to 0.4 (*) | a pyramid or, by chance, a bowl | 2.01 m |
| stairs_up | steps 0.05 to 0.23 m high (*), which climb towards the platform | 0.3 m deep (*) | 3.01 m |
| stairs_down | the same, which descend towards the platform | 0.3 m deep (*) | 3.01 m |
| boxes | tops within +-0.05 to +-0.2 m (*) | 0.45 m squares (*) | 2.01 m |
| stepping_stones | 1 to 0.25 m wide, 0.05 to 0.3 m apart, tops within +-0 to +-0.05 m | holes 1 m deep | 2.01 m |
| gaps | 0.1 to 0.8 m wide | 1 m deep, 1 m of ground between | 3.01 m |
| rough | within +-0.01 to +-0.05 m (**) | a height each 0.2 m (**), bilinear between | 2 m |
| rails | 0.05 to 0.25 m high | 0.06 m thick, 0.8 m apart | 3.01 m |

(*) as in Isaac Lab's rough terrains; platforms are 1 cm wider, so that no edge lies on a sample of a 4 cm field.
(**) hardest as in legged_gym. All else is chosen.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

TABLE = 64  # numbers along each side of a tile's table; the pattern repeats after so many lattice cells
SMALL, LARGE = 1.005, 1.505  # [m] half of a platform's side
STEP_DEPTH = 0.3  # [m] of stairs
BOX = 0.45  # [m] side of a box
BOX_SHIFT = 0.013  # [m] moves the edges of boxes off a field's samples
HOLE = 1.0  # [m] depth of gaps and between stones
STRIP = 1.0  # [m] of ground between gaps
BUMP = 0.2  # [m] between heights of rough ground
FLAT_BUMPS = 5  # rough ground starts so many of them from the origin
RAIL, RAIL_DISTANCE = 0.06, 0.8  # [m]

Shape = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]


def out(x: Tensor, y: Tensor) -> Tensor:
    """Return the distance from the start in squares, r = max(|x|, |y|)."""
    return torch.maximum(x.abs(), y.abs())


def between(low: float, high: float, difficulty: Tensor) -> Tensor:
    """Return the value at a difficulty."""
    return low + (high - low) * difficulty


def chance(random: Tensor, i: Tensor, j: Tensor, channel: int = 0) -> Tensor:
    """Return the number from -1 to 1 of lattice cell (i, j), whole numbers (B, M)."""
    # Channels are the same table, shifted by more cells than a tile has.
    row, column = (i + 21 * channel).remainder(TABLE).long(), j.remainder(TABLE).long()
    return 2 * random.gather(1, row * TABLE + column) - 1


def flat(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return flat ground."""
    return torch.zeros_like(x)


def slope(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return a pyramid's sides or a bowl's, around the platform."""
    up = torch.where(random[:, :1] < 0.5, -1.0, 1.0)
    return up * between(0.0, 0.4, difficulty) * (out(x, y) - SMALL).clamp(min=0)


def stairs_down(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return stairs that descend towards the platform, from all sides."""
    count = torch.ceil((out(x, y) - LARGE) / STEP_DEPTH).clamp(min=0)
    return between(0.05, 0.23, difficulty) * count


def stairs_up(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return stairs that climb towards the platform, from all sides."""
    return 0.0 - stairs_down(x, y, difficulty, random)


def boxes(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return squares, each at a height of its own."""
    i, j = (torch.floor((a - BOX_SHIFT) / BOX) for a in (x, y))
    top = between(0.05, 0.2, difficulty) * chance(random, i, j)
    return torch.where(out(x, y) < SMALL, 0.0, top)


def stepping_stones(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return stones over holes, moved by up to a quarter of their distance, each at a height of its own."""
    wide, apart = between(1.0, 0.25, difficulty), between(0.05, 0.3, difficulty)
    i, j = (torch.round(a / (wide + apart)) for a in (x, y))
    x_off, y_off = (k * (wide + apart) + apart / 4 * chance(random, i, j, c) for c, k in enumerate((i, j)))
    top = 0.05 * difficulty * chance(random, i, j, 2)
    z = torch.where(out(x - x_off, y - y_off) < wide / 2, top, -HOLE)
    return torch.where(out(x, y) < SMALL, 0.0, z)


def gaps(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return square moats around the platform."""
    wide, beyond = between(0.1, 0.8, difficulty), out(x, y) - LARGE
    return torch.where((beyond >= 0) & (beyond.remainder(wide + STRIP) < wide), -HOLE, 0.0).to(x.dtype)


def rough(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return random heights on a lattice, bilinear between."""
    i, j = (torch.floor(a / BUMP) for a in (x, y))
    u, v = x / BUMP - i, y / BUMP - j
    a, b, c, d = (_bump(random, i + di, j + dj) for di, dj in ((0, 0), (1, 0), (0, 1), (1, 1)))
    z = (a * (1 - u) + b * u) * (1 - v) + (c * (1 - u) + d * u) * v
    return between(0.01, 0.05, difficulty) * z


def _bump(random: Tensor, i: Tensor, j: Tensor) -> Tensor:
    return torch.where(out(i, j) <= FLAT_BUMPS, 0.0, chance(random, i, j))


def rails(x: Tensor, y: Tensor, difficulty: Tensor, random: Tensor) -> Tensor:
    """Return square bars around the platform, to trip over."""
    beyond = out(x, y) - LARGE
    there = (beyond >= 0) & (beyond.remainder(RAIL_DISTANCE) < RAIL)
    return torch.where(there, between(0.05, 0.25, difficulty), 0.0)


SHAPES: dict[str, Shape] = {
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
