"""Scenes whose ground height is known exactly.

A scene is a continuous terrain in closed form, with boxes. Grounded boxes (stairs, walls, crates) are part of the
ground height: their edges are exact steps and their faces exactly vertical. Other boxes float, move or disappear (a
bar, a ceiling, a person). Edges are placed at odd coordinates, so that they do not all lie on borders of 4 cm cells.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchelev.sim.waves import natural_waves

_BOTTOM = -20.0  # [m] lower end of grounded boxes


@dataclass(frozen=True, kw_only=True)
class Box:
    """An axis-aligned box in the map frame, which may move, and which exists while since <= t < until."""

    low: tuple[float, float, float]  #: [m] lowest corner at t = 0
    high: tuple[float, float, float]  #: [m] highest corner at t = 0
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: [m/s]
    since: float = -math.inf  #: [s] when the box appears
    until: float = math.inf  #: [s] when the box disappears
    grounded: bool = False  #: whether the top is part of the ground height

    def corners(self, t: float) -> tuple[list[float], list[float]]:
        """Return the lowest and the highest corner [m] at time t [s]."""
        low, high = (
            [a + v * t for a, v in zip(corner, self.velocity, strict=True)] for corner in (self.low, self.high)
        )
        return low, high

    def exists(self, t: float) -> bool:
        """Return whether the box exists at time t [s]."""
        return self.since <= t < self.until

    def covers(self, x: Tensor, y: Tensor, t: float = 0.0) -> Tensor:
        """Return which places x, y [m], of any shape, lie within the outline of the box seen from above."""
        low, high = self.corners(t)
        return (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])


def _plane(x: Tensor, y: Tensor) -> Tensor:
    return torch.zeros_like(x)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A continuous terrain with boxes on it.

    Ray casting relies on the terrain being continuous and nowhere steeper than `steepness`.
    """

    name: str = "flat"  #: for tables and pictures
    terrain: Callable[[Tensor, Tensor], Tensor] = _plane  #: height [m] at x, y [m], of any shape
    steepness: float = 0.0  #: upper bound of the terrain's |gradient|
    boxes: tuple[Box, ...] = field(default_factory=tuple)  #: grounded, floating and moving boxes

    def height(self, x: Tensor, y: Tensor, t: float = 0.0, below: float = math.inf) -> Tensor:
        """Return the height of the ground [m]: the higher one of terrain and grounded boxes.

        Args:
            x: [m] map frame, of any shape.
            y: [m] map frame, of the shape of `x`.
            t: Time [s].
            below: Boxes whose top lies higher are left out [m]. In a building this selects the floor.
        """
        z = self.terrain(x, y)
        for box in self.boxes:
            top = box.corners(t)[1][2]
            if box.grounded and box.exists(t) and top <= below:
                z = torch.where(box.covers(x, y, t), z.clamp(min=top), z)
        return z

    def truth(self, xy: Tensor, t: float = 0.0, below: float = math.inf) -> Tensor:
        """Return the `height` at xy (..., 2) [m] in float64: the ground truth of an elevation map."""
        xy = xy.double()
        return self.height(xy[..., 0], xy[..., 1], t, below)

    def ceiling(self, xy: Tensor, ground: Tensor, t: float = 0.0) -> Tensor:
        """Return the lowest underside [m] of a box above `ground` (...,) [m] at xy (..., 2) [m]; inf without one."""
        x, y = xy.double().unbind(-1)
        lowest = torch.full_like(x, math.inf)
        for box in self.boxes:
            under = box.corners(t)[0][2]
            if box.exists(t):
                lowest = torch.where(box.covers(x, y, t) & (under > ground), lowest.clamp(max=under), lowest)
        return lowest

    def is_covered(self, xy: Tensor, t: float = 0.0) -> Tensor:
        """Return which places xy (..., 2) [m] lie under or in a box that is not grounded (bar, ceiling, person)."""
        is_covered = torch.zeros(xy.shape[:-1], dtype=torch.bool)
        for box in self.boxes:
            if box.exists(t) and not box.grounded:
                is_covered = is_covered | box.covers(xy[..., 0], xy[..., 1], t)
        return is_covered


def block(x0: float, x1: float, y0: float, y1: float, top: float) -> Box:
    """Make a grounded box from x0 to x1 and from y0 to y1, up to `top` [m]."""
    return Box(low=(x0, y0, _BOTTOM), high=(x1, y1, top), grounded=True)


def steps(x0: float, y0: float, y1: float, *, count: int, rise: float, run: float, base: float = 0.0) -> list[Box]:
    """Make `count` stairs that climb along +x from x = x0 [m], each step reaching under the following ones."""
    end = x0 + count * run
    return [block(x0 + k * run, end, y0, y1, base + (k + 1) * rise) for k in range(count)]


def flat() -> Scene:
    """Return flat ground at z = 0."""
    return Scene(name="flat")


def slope(angle_deg: float = 15.0) -> Scene:
    """Return a plane that rises along +x."""
    gradient = math.tan(math.radians(angle_deg))
    return Scene(name="slope", terrain=lambda x, y: gradient * x, steepness=abs(gradient))


def rough(seed: int = 0) -> Scene:
    """Return smooth rough ground of about +-8 cm."""
    relief = natural_waves(seed)
    return Scene(name="rough", terrain=relief, steepness=relief.steepness)


def stairs(rise: float = 0.17, run: float = 0.29, count: int = 8) -> Scene:
    """Return stairs along +x from x = 0.613 m up to a landing, 12 m wide so that their sides stay out of view."""
    climb = steps(0.613, -6.0, 6.0, count=count, rise=rise, run=run)
    landing = block(0.613 + count * run, 12.0, -6.0, 6.0, count * rise)
    return Scene(name="stairs", boxes=(*climb, landing))


def boxes(seed: int = 0, count: int = 24) -> Scene:
    """Return flat ground with boxes of 10 to 50 cm height between 0.7 and 4 m from the origin."""
    return Scene(name="boxes", boxes=tuple(crates(seed, count, (-4.0, 4.0, -4.0, 4.0), keep_off=0.7)))


def crates(seed: int, count: int, area: tuple[float, float, float, float], keep_off: float = 0.0) -> list[Box]:
    """Make boxes of 10 to 50 cm height in area (x0, x1, y0, y1) [m], at least `keep_off` [m] from the origin."""
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
    """Return rough ground behind (x < -1), a ramp of 15 degrees on the left (y > 1), stairs ahead, boxes right."""
    relief = natural_waves(seed, amplitude=0.06)
    gradient = math.tan(math.radians(15.0))

    def terrain(x: Tensor, y: Tensor) -> Tensor:
        ramp = gradient * (y - 1.013).clamp(0.0, 2.0)
        return ramp + relief(x, y) * (-(x + 1.0)).clamp(0.0, 1.0)

    climb = steps(1.217, -0.787, 0.913, count=6, rise=0.17, run=0.29)
    landing = block(1.217 + 6 * 0.29, 4.5, -0.787, 0.913, 6 * 0.17)
    aside = crates(seed + 1, 9, (-0.8, 3.6, -3.7, -1.4))
    # Fading the relief in over 1 m adds its height to its slope.
    steepness = gradient + relief.steepness + 0.1
    return Scene(name="mixed", terrain=terrain, steepness=steepness, boxes=(*climb, landing, *aside))


def wall() -> Scene:
    """Return flat ground with walls of 0.5 m and 1 m height and an obstacle of 12 cm ahead of the origin."""
    low = block(1.987, 2.203, -2.5, -0.313, 0.5)
    high = block(2.493, 2.711, 0.307, 2.9, 1.0)
    obstacle = block(1.213, 1.437, -0.191, 0.227, 0.12)
    return Scene(name="wall", boxes=(low, high, obstacle))


def overhang() -> Scene:
    """Return flat ground with a bar across the path at 1.15 m, a box behind it, and a ceiling at 2.3 m from x = 3 m."""
    bar = Box(low=(1.413, -1.5, 1.15), high=(1.527, 1.5, 1.31))
    ceiling = Box(low=(3.007, -4.0, 2.3), high=(8.0, 4.0, 2.5))
    obstacle = block(2.213, 2.531, -0.409, 0.317, 0.15)
    return Scene(name="overhang", boxes=(bar, ceiling, obstacle))


def person(until: float = 3.0, x: float = 1.713, y: float = -0.2) -> Scene:
    """Return flat ground with a person of 0.4 x 0.5 x 1.7 m at (x, y) [m] who disappears at t = `until` [s]."""
    body = Box(low=(x, y, 0.0), high=(x + 0.4, y + 0.5, 1.7), until=until)
    return Scene(name="person", boxes=(body,))


def two_floors(storey: float = 2.72) -> Scene:
    """Return a lower floor at z = 0, stairs beside it that climb along +x, and an upper floor above the lower one.

    The stairs lie at 1.013 < y < 2.213 m from x = -2.32 to 2.32 m, followed by a landing. The upper floor, a slab of
    0.2 m, covers -6 < x < 6 m beside them: a robot that has climbed the stairs can walk back above its own path.
    """
    rise, run, count = 0.17, 0.29, 16
    assert abs(storey - rise * count) < 1e-9
    start, end = -count * run / 2, count * run / 2
    climb = steps(start, 1.013, 2.213, count=count, rise=rise, run=run)
    landing = block(end, 6.0, 1.013, 2.213, storey)
    upper = Box(low=(-6.0, -3.0, storey - 0.2), high=(6.0, 1.013, storey), grounded=True)
    return Scene(name="two floors", boxes=(*climb, landing, upper))
