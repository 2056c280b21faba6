"""A robot's sizes in whole cells: the windows that the learned head looks at, and where the feet of each stance are."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction
from typing import NamedTuple

from torchelev.robot import RobotConfig

Cells = tuple[int, int]  # along x and y; of places, from the cell under the body's centre


class Way(NamedTuple):
    """From foot to foot, in cells from the first: 3 x 3 cells around each place and the feet leave none out."""

    end: Cells  #: the other foot
    places: tuple[Cells, ...]  #: between the feet, evenly
    spacing: float  #: at most


class Stance(NamedTuple):
    """A heading of the body over a cell, in cells."""

    feet: tuple[Cells, ...]  #: front left, front right, hind left, hind right
    spine: tuple[Cells, ...]  #: centres of squares under the body: the middle, the front, the hind one
    length: float  #: between front and hind feet
    width: float  #: between left and right feet

    @property
    def diagonal(self) -> bool:
        """Whether the heading lies between the axes."""
        (i, j), (k, m) = self.feet[:2]
        return i != k and j != m

    @property
    def ways(self) -> dict[Way, list[Cells]]:
        """The ways between neighbouring feet, each with the feet it starts from; opposite ones are mostly alike."""
        starts: dict[Way, list[Cells]] = {}
        for m, n in ((0, 1), (2, 3), (0, 2), (1, 3)):
            starts.setdefault(_way(self.feet[m], self.feet[n]), []).append(self.feet[m])
        return starts

    def turned(self) -> Stance:
        """Return the stance a quarter turn on."""
        feet, spine = (tuple((-j, i) for i, j in places) for places in (self.feet, self.spine))
        return Stance(feet, spine, self.length, self.width)


def _way(a: Cells, b: Cells) -> Way:
    """Return the way between two cells, with places 3 cells or less apart along x and y."""
    parts = math.ceil(max(abs(b[0] - a[0]), abs(b[1] - a[1])) / 3)
    shares = [Fraction(k, parts) for k in range(1, parts)]  # exact, so that neither end comes first
    # Python rounds halves to even numbers, so that opposite places stay opposite.
    places = [(round(a[0] + k * (b[0] - a[0])), round(a[1] + k * (b[1] - a[1]))) for k in shares]
    spacing = max(math.dist(p, q) for p, q in itertools.pairwise((a, *places, b)))
    end, *places = ((i - a[0], j - a[1]) for i, j in (b, *places))
    return Way(end, tuple(places), spacing)


def stances(robot: RobotConfig, resolution: float) -> tuple[Stance, ...]:
    """Return the stances at headings of 0, 90, 45 and 135 degrees, which turns and mirrors of the map interchange.

    No two feet share a cell, however coarse.
    """
    half, diagonal = 0.5 / resolution, math.sqrt(0.5)
    length, width = robot.length * half, robot.width * half
    p, q, s = max(1, round(length)), max(1, round(width)), round(length - width)
    along = Stance(((p, q), (p, -q), (-p, q), (-p, -q)), ((0, 0), (s, 0), (-s, 0)), 2 * p, 2 * q)
    a, s = max(1, round((length + width) * diagonal)), round((length - width) * diagonal)
    b = min(a - 1, round((length - width) * diagonal))
    feet = ((b, a), (a, b), (-a, -b), (-b, -a))
    across = Stance(feet, ((0, 0), (s, s), (-s, -s)), (a + b) / diagonal, (a - b) / diagonal)
    return along, along.turned(), across, across.turned()


class Scales(NamedTuple):
    """Windows, how they grow, and how far they are needed, in cells."""

    steps: tuple[tuple[int, ...], ...]  #: of each window over the one before
    stances: tuple[Stance, ...]  #: one for each heading

    @property
    def foot(self) -> int:
        """Farthest foot from the body's centre, along x or y."""
        return max(abs(n) for stance in self.stances for place in stance.feet for n in place)

    @property
    def spine(self) -> int:
        """Farthest square under the body."""
        return max(abs(n) for stance in self.stances for place in stance.spine for n in place)

    @property
    def radii(self) -> tuple[int, ...]:
        """Of the windows."""
        return tuple(itertools.accumulate(sum(steps) for steps in self.steps))

    @property
    def reach(self) -> int:
        """Radius of the window of a foot's reach."""
        return self.radii[1]

    @property
    def body(self) -> int:
        """Radius of the window of half the body's width."""
        return self.radii[2]

    @property
    def stood_on(self) -> int:
        """Rim within which feet may stand, within reach of their places."""
        return self.foot + self.reach

    @property
    def margin(self) -> int:
        """Rim that the windows around feet and body need."""
        return max(self.stood_on + self.reach, self.spine + self.body)

    @property
    def rim(self) -> int:
        """Rim that the map needs."""
        return self.margin + self.radii[-1]


def in_cells(robot: RobotConfig, resolution: float) -> Scales:
    """Return the robot's windows: the cell and its neighbours, a foot's reach, half the body's width, half its length.

    Each holds the one before. It is made of it in steps that at most triple its width, so that no cell is left out.
    """
    steps, radius = [], 0
    for length in (resolution, robot.foot_reach, robot.width / 2, robot.length / 2):
        steps.append(_steps(radius, round(length / resolution)))
        radius += sum(steps[-1])
    return Scales(tuple(steps), stances(robot, resolution))


def _steps(radius: int, wanted: int) -> tuple[int, ...]:
    """Return by how many cells to grow, one step after the other, from one radius to another."""
    steps = []
    while radius < wanted:
        steps.append(min(wanted - radius, 2 * radius + 1))
        radius += steps[-1]
    return tuple(steps)
