"""Structures as boxes: tables, doorways, beams, tunnels and bridges, around the origin on ground at z = 0.

A structure is a list of `Part`; `placed` moves it to where it stands. `height` is everywhere the free height below it.
The exact scenes of `torchelev.sim.exact.covered_scenes` have the same kinds for a single robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from torchelev.errors import require_positive

RISE, RUN = 0.17, 0.29  # [m] of a stair


class Part(NamedTuple):
    """A box whose z axis is vertical."""

    center: tuple[float, float, float]  #: [m]
    half_size: tuple[float, float, float]  #: [m] along its own axes
    yaw: float = 0.0  #: [rad] of its x axis


def _between(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Part:
    """Return the box of these limits."""
    limits = (x, y, z)
    center, half = ([(a[1] + sign * a[0]) / 2 for a in limits] for sign in (1, -1))
    return Part((center[0], center[1], center[2]), (half[0], half[1], half[2]))


def placed(parts: Sequence[Part], x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> list[Part]:
    """Return a structure turned by `yaw` [rad] and moved to x, y and z [m]."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return [
        Part((x + cos * a - sin * b, y + sin * a + cos * b, z + c), half, own + yaw) for (a, b, c), half, own in parts
    ]


def table(
    height: float = 0.7, length: float = 1.6, width: float = 0.9, thickness: float = 0.04, leg: float = 0.06
) -> list[Part]:
    """Return a table top and four legs.

    Args:
        height: Of the underside of the top [m].
        length: Along x [m].
        width: Along y [m].
        thickness: Of the top [m].
        leg: Side of a leg [m].

    Raises:
        ValueError: A length is not positive.
    """
    require_positive(height=height, length=length, width=width, thickness=thickness, leg=leg)
    half = (length / 2, width / 2)
    top = _between((-half[0], half[0]), (-half[1], half[1]), (height, height + thickness))
    place = [(half[k] - leg / 2) for k in (0, 1)]
    size = (leg / 2, leg / 2, height / 2)
    return [top, *(Part((a * place[0], b * place[1], height / 2), size) for a in (-1, 1) for b in (-1, 1))]


def beam(height: float = 0.7, length: float = 2.0, width: float = 0.1, thickness: float = 0.1) -> list[Part]:
    """Return a beam along y that nothing carries: with a large width it is a low ceiling.

    Args:
        height: Of its underside [m].
        length: Along y [m].
        width: Along x [m].
        thickness: Along z [m].

    Raises:
        ValueError: A length is not positive.
    """
    require_positive(height=height, length=length, width=width, thickness=thickness)
    return [_between((-width / 2, width / 2), (-length / 2, length / 2), (height, height + thickness))]


def doorway(
    height: float = 1.8, width: float = 0.9, wall_height: float = 2.4, wall_length: float = 4.0, thickness: float = 0.15
) -> list[Part]:
    """Return a wall along y with a door in its middle: two pieces of wall and the lintel between them.

    Args:
        height: Of the underside of the lintel [m].
        width: Of the door [m].
        wall_height: Of the wall [m], more than `height`.
        wall_length: Of the wall [m], more than `width`.
        thickness: Of the wall [m].

    Raises:
        ValueError: A length is not positive, or the door is as large as the wall.
    """
    require_positive(height=height, width=width, thickness=thickness)
    require_positive(**{"wall_height - height": wall_height - height, "wall_length - width": wall_length - width})
    x, half, end = (-thickness / 2, thickness / 2), width / 2, wall_length / 2
    walls = [_between(x, y, (0.0, wall_height)) for y in ((-end, -half), (half, end))]
    return [*walls, _between(x, (-half, half), (height, wall_height))]


def culvert(
    height: float = 0.9, width: float = 1.2, length: float = 4.0, wall: float = 0.3, roof: float = 0.3
) -> list[Part]:
    """Return a tunnel along x: two walls and a roof.

    Args:
        height: Inside [m].
        width: Inside [m].
        length: Along x [m].
        wall: Thickness of the walls [m].
        roof: Thickness of the roof [m].

    Raises:
        ValueError: A length is not positive.
    """
    require_positive(height=height, width=width, length=length, wall=wall, roof=roof)
    x, half = (-length / 2, length / 2), width / 2
    walls = [_between(x, y, (0.0, height + roof)) for y in ((-half - wall, -half), (half, half + wall))]
    return [*walls, _between(x, (-half, half), (height, height + roof))]


def bridge(height: float = 1.8, span: float = 4.0, width: float = 2.0, thickness: float = 0.25) -> list[Part]:
    """Return a bridge along x: a deck, and stairs that climb to it from both sides.

    Args:
        height: Of the underside of the deck [m].
        span: Length of the deck [m].
        width: Along y [m].
        thickness: Of the deck [m].

    Raises:
        ValueError: A length is not positive.
    """
    require_positive(height=height, span=span, width=width, thickness=thickness)
    y, half, top = (-width / 2, width / 2), span / 2, height + thickness
    parts = [_between((-half, half), y, (height, top))]
    count = max(1, round(top / RISE))
    for k in range(1, count):
        far, near = half + (count - k) * RUN, half + (count - k - 1) * RUN
        z = (0.0, k * top / count)
        parts += [_between((near, far), y, z), _between((-far, -near), y, z)]
    return parts
