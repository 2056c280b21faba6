"""Scenes with more than one height: what hangs over the ground, and floors above each other.

`Scene.height(..., below=)` is the ground of a robot whose feet are lower, `Scene.ceiling` what it can bump into.
"""

from __future__ import annotations

import torch

from torchelev.sim.exact.scenes import Box, Scene, block, steps

RISE, RUN = 0.17, 0.29  # [m] of a stair
SLAB = 0.2  # [m] thickness of a floor


def table(height: float = 0.74) -> Scene:
    """Return flat ground with a table of 1.6 x 0.9 m at 1.2 < x < 2.8 m, whose underside is at `height` [m]."""
    low, high = (1.213, -0.447), (2.813, 0.453)
    top = Box(low=(*low, height), high=(*high, height + 0.04))
    corners = [(x, y) for x in (low[0], high[0] - 0.06) for y in (low[1], high[1] - 0.06)]
    legs = [block(x, x + 0.06, y, y + 0.06, height) for x, y in corners]
    return Scene(name="table", boxes=(top, *legs))


def bridge(count: int = 12) -> Scene:
    """Return a bridge along x, 2 m wide, with `count` stairs on both sides of a deck of 4 m, and a road under it."""
    half, deck = 2.013, count * RISE
    up = steps(-half - count * RUN, -1.0, 1.0, count=count, rise=RISE, run=RUN)
    down = [block(half, half + (k + 1) * RUN, -1.0, 1.0, (count - k) * RISE) for k in range(count)]
    slab = Box(low=(-half, -1.0, deck - 0.25), high=(half, 1.0, deck), grounded=True)
    return Scene(name="bridge", boxes=(*up, *down, slab))


def stairwell(count: int = 8) -> Scene:
    """Return three flights of `count` stairs, the third above the first, with landings between them.

    The first climbs along +x at 0.1 < y < 1.1 m from x = 0, the second back along -x at -1.1 < y < -0.1 m.
    """
    end, climb = count * RUN, count * RISE
    boxes = list(_flight(0.0, 1, 0.1, 1.1, 0.0, count))
    boxes += _flight(end, -1, -1.1, -0.1, climb, count)
    boxes += _flight(0.0, 1, 0.1, 1.1, 2 * climb, count)
    for k, x in enumerate((end, -1.2, end), 1):
        boxes.append(Box(low=(x, -1.1, k * climb - SLAB), high=(x + 1.2, 1.1, k * climb), grounded=True))
    return Scene(name="stairwell", boxes=tuple(boxes))


def _flight(x: float, direction: int, y0: float, y1: float, base: float, count: int) -> list[Box]:
    """Return stairs without what is under them, which climb from x [m] along +x or -x."""
    made = []
    for k in range(count):
        ends = sorted((x + direction * k * RUN, x + direction * (k + 1) * RUN))
        top = base + (k + 1) * RISE
        made.append(Box(low=(ends[0], y0, top - RISE - 0.08), high=(ends[1], y1, top), grounded=True))
    return made


def door(height: float = 1.8, ceiling: float = 2.4) -> Scene:
    """Return a corridor of 2 m along x under a ceiling, with a door frame of 0.9 m x `height` [m] at x = 2 m."""
    walls = [block(-6.0, 8.0, y, y + 0.15, ceiling) for y in (-1.15, 1.0)]
    jambs = [block(2.013, 2.163, *y, ceiling) for y in ((-1.0, -0.45), (0.45, 1.0))]
    lintel = Box(low=(2.013, -0.45, height), high=(2.163, 0.45, ceiling))
    roof = Box(low=(-6.0, -1.15, ceiling), high=(8.0, 1.15, ceiling + SLAB))
    return Scene(name="door", boxes=(*walls, *jambs, lintel, roof))


def culvert(height: float = 0.9, width: float = 1.2) -> Scene:
    """Return an embankment of 1.6 m across the path at 2 < x < 6 m, and a culvert through it."""
    low, high, top = 2.013, 6.013, 1.6
    sides = [block(low, high, *y, top) for y in ((-5.0, -width / 2), (width / 2, 5.0))]
    roof = Box(low=(low, -width / 2, height), high=(high, width / 2, top), grounded=True)
    return Scene(name="culvert", boxes=(*sides, roof))


def branches(seed: int = 0, count: int = 40) -> Scene:
    """Return flat ground under thin branches, 3 cm thick and 0.4 to 2 m above it, from 1 to 4 m ahead."""
    u = torch.rand(count, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).tolist()
    made = []
    for x, y, z, turn in u:
        length = (0.8, 0.03) if turn < 0.5 else (0.03, 0.8)
        corner = (1.0 + 3.0 * x, -1.5 + 3.0 * y, 0.4 + 1.6 * z)
        made.append(Box(low=corner, high=(corner[0] + length[0], corner[1] + length[1], corner[2] + 0.03)))
    return Scene(name="branches", boxes=tuple(made))


def all_scenes() -> list[Scene]:
    """Return each of these scenes with its defaults."""
    return [table(), bridge(), stairwell(), door(), culvert(), branches()]
