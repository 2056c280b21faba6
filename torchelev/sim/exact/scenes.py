"""Scenes whose ground height is known exactly.

A scene is a continuous terrain in closed form and boxes. Boxes that stand on the ground (stairs, walls, crates) are
part of the ground height, so every step is an exact discontinuity and every vertical face is hit exactly; the others
float or come and go (a bar, a ceiling, a person). Edges lie at odd places: not all on borders of 4 cm cells.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchelev.sim.waves import natural_waves

DEEP = -20.0  # [m] where boxes that stand on the ground begin


@dataclass(frozen=True, kw_only=True)
class Box:
    """An axis-aligned box, from `low` to `high` [m, map frame] at t = 0, there while since <= t < until [s]."""

    low: tuple[float, float, float]  #: [m] lowest corner
    high: tuple[float, float, float]  #: [m] highest corner
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: [m/s]
    since: float = -math.inf  #: [s]
    until: float = math.inf  #: [s]
    grounded: bool = False  #: its top is ground: part of the scene's height

    def corners(self, t: float) -> tuple[list[float], list[float]]:
        """Return the low and the high corner [m] at time t [s]."""
        shift = [v * t for v in self.velocity]
        return [a + s for a, s in zip(self.low, shift, strict=True)], [
            a + s for a, s in zip(self.high, shift, strict=True)
        ]

    def exists(self, t: float) -> bool:
        """Tell whether the box is there at time t [s]."""
        return self.since <= t < self.until

    def covers(self, x: Tensor, y: Tensor, t: float = 0.0) -> Tensor:
        """Tell which places (any shape) lie under or over the box."""
        low, high = self.corners(t)
        return (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])


def _plane(x: Tensor, y: Tensor) -> Tensor:
    return torch.zeros_like(x)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A terrain and boxes.

    `terrain(x, y) -> z` must be continuous, with a slope of `steepness` or less everywhere: ray casting relies on it.
    """

    name: str = "flat"  #: for tables and pictures
    terrain: Callable[[Tensor, Tensor], Tensor] = _plane  #: height [m] of the ground at x, y [m]
    steepness: float = 0.0  #: upper bound of |gradient|
    boxes: tuple[Box, ...] = field(default_factory=tuple)  #: what stands on the ground

    def height(self, x: Tensor, y: Tensor, t: float = 0.0, below: float = math.inf) -> Tensor:
        """Return the ground's height [m], any shape: the higher of terrain and boxes that stand on the ground.

        Boxes whose top lies above `below` [m] are left out: in a building, the floor one stands on.
        """
        z = self.terrain(x, y)
        for box in self.boxes:
            top = box.corners(t)[1][2]
            if box.grounded and box.exists(t) and top <= below:
                z = torch.where(box.covers(x, y, t), z.clamp(min=top), z)
        return z

    def truth(self, xy: Tensor, t: float = 0.0, below: float = math.inf) -> Tensor:
        """Return `height` at xy (..., 2) [m]: what an elevation map should say."""
        xy = xy.double()
        return self.height(xy[..., 0], xy[..., 1], t, below)

    def covered(self, xy: Tensor, t: float = 0.0) -> Tensor:
        """Tell which places xy (..., 2) lie under or in a box that is not ground (bar, ceiling, person)."""
        under = torch.zeros(xy.shape[:-1], dtype=torch.bool)
        for box in self.boxes:
            if box.exists(t) and not box.grounded:
                under = under | box.covers(xy[..., 0], xy[..., 1], t)
        return under


def block(x0: float, x1: float, y0: float, y1: float, top: float) -> Box:
    """Make a box that stands on the ground, up to `top` [m]."""
    return Box(low=(x0, y0, DEEP), high=(x1, y1, top), grounded=True)


def steps(x0: float, y0: float, y1: float, *, count: int, rise: float, run: float, base: float = 0.0) -> list[Box]:
    """Make `count` stairs that climb along +x from x0 [m]; each reaches below those after it."""
    end = x0 + count * run
    return [block(x0 + k * run, end, y0, y1, base + (k + 1) * rise) for k in range(count)]


def flat() -> Scene:
    """Make flat ground at z = 0."""
    return Scene(name="flat")


def slope(angle_deg: float = 15.0) -> Scene:
    """Make a plane that rises along +x."""
    gradient = math.tan(math.radians(angle_deg))
    return Scene(name="slope", terrain=lambda x, y: gradient * x, steepness=abs(gradient))


def rough(seed: int = 0) -> Scene:
    """Make smooth rough ground of about +-8 cm."""
    relief = natural_waves(seed)
    return Scene(name="rough", terrain=relief, steepness=relief.steepness)


def stairs(rise: float = 0.17, run: float = 0.29, count: int = 8) -> Scene:
    """Make stairs that climb along +x from x = 0.613 m to a landing, 12 m wide so that no side is seen."""
    climb = steps(0.613, -6.0, 6.0, count=count, rise=rise, run=run)
    landing = block(0.613 + count * run, 12.0, -6.0, 6.0, count * rise)
    return Scene(name="stairs", boxes=(*climb, landing))


def boxes(seed: int = 0, count: int = 24) -> Scene:
    """Make boxes of 10 to 50 cm height on flat ground, within 4 m, none nearer than 0.7 m to the origin."""
    return Scene(name="boxes", boxes=tuple(crates(seed, count, (-4.0, 4.0, -4.0, 4.0), keep_off=0.7)))


def crates(seed: int, count: int, area: tuple[float, float, float, float], keep_off: float = 0.0) -> list[Box]:
    """Make `count` boxes of 10 to 50 cm within area (x0, x1, y0, y1) [m], `keep_off` [m] or more from the origin."""
    generator = torch.Generator().manual_seed(seed)
    made: list[Box] = []
    while len(made) < count:
        u = torch.rand(5, generator=generator, dtype=torch.float64).tolist()
        x = area[0] + u[0] * (area[1] - area[0])
        y = area[2] + u[1] * (area[3] - area[2])
        half_x, half_y, top = 0.1 + 0.25 * u[2], 0.1 + 0.25 * u[3], 0.1 + 0.4 * u[4]
        if math.hypot(max(abs(x) - half_x, 0.0), max(abs(y) - half_y, 0.0)) > keep_off:
            made.append(block(x - half_x, x + half_x, y - half_y, y + half_y, top))
    return made


def mixed(seed: int = 0) -> Scene:
    """Make rough ground behind (x < -1), a ramp of 15 degrees to the left (y > 1), stairs ahead, boxes to the right."""
    relief = natural_waves(seed, amplitude=0.06)
    gradient = math.tan(math.radians(15.0))

    def terrain(x: Tensor, y: Tensor) -> Tensor:
        ramp = gradient * (y - 1.013).clamp(0.0, 2.0)
        return ramp + relief(x, y) * (-(x + 1.0)).clamp(0.0, 1.0)

    climb = steps(1.217, -0.787, 0.913, count=6, rise=0.17, run=0.29)
    landing = block(1.217 + 6 * 0.29, 4.5, -0.787, 0.913, 6 * 0.17)
    aside = crates(seed + 1, 9, (-0.8, 3.6, -3.7, -1.4))
    # The relief is faded in over 1 m, which adds its height to its slope.
    steepness = gradient + relief.steepness + 0.1
    return Scene(name="mixed", terrain=terrain, steepness=steepness, boxes=(*climb, landing, *aside))


def wall() -> Scene:
    """Make walls of 0.5 m and 1 m height and a low obstacle of 12 cm on flat ground, ahead of the origin."""
    low = block(1.987, 2.203, -2.5, -0.313, 0.5)
    high = block(2.493, 2.711, 0.307, 2.9, 1.0)
    obstacle = block(1.213, 1.437, -0.191, 0.227, 0.12)
    return Scene(name="wall", boxes=(low, high, obstacle))


def overhang() -> Scene:
    """Make a bar across the way 1.15 m over flat ground, a ceiling at 2.3 m from x = 3 on, a box behind the bar."""
    bar = Box(low=(1.413, -1.5, 1.15), high=(1.527, 1.5, 1.31))
    ceiling = Box(low=(3.007, -4.0, 2.3), high=(8.0, 4.0, 2.5))
    obstacle = block(2.213, 2.531, -0.409, 0.317, 0.15)
    return Scene(name="overhang", boxes=(bar, ceiling, obstacle))


def person(until: float = 3.0, x: float = 1.713, y: float = -0.2) -> Scene:
    """Make flat ground with a person, 0.4 x 0.5 x 1.7 m, who stands at (x, y) and is gone from t = `until` [s] on."""
    body = Box(low=(x, y, 0.0), high=(x + 0.4, y + 0.5, 1.7), until=until)
    return Scene(name="person", boxes=(body,))


def two_floors(storey: float = 2.72) -> Scene:
    """Make a lower floor (z = 0), stairs up along +x beside it and an upper floor that lies over the lower one.

    The stairs occupy 1.013 < y < 2.213 from x = -2.32 to 2.32 m, a landing follows; the upper slab (0.2 m thick) spans
    -6 < x < 6 at y < 0.987 and the landing, so that who comes up can walk back over the way that led to the stairs.
    """
    rise, run, count = 0.17, 0.29, 16
    assert abs(storey - rise * count) < 1e-9
    start, end = -count * run / 2, count * run / 2
    climb = steps(start, 1.013, 2.213, count=count, rise=rise, run=run)
    landing = block(end, 6.0, 1.013, 2.213, storey)
    upper = Box(low=(-6.0, -3.0, storey - 0.2), high=(6.0, 1.013, storey), grounded=True)
    return Scene(name="two floors", boxes=(*climb, landing, upper))
