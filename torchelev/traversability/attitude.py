"""The body's attitude over every cell at each heading: the features by which the learned head rates a stance.

The same on turned and mirrored maps: of the two ends of a line, neither comes first.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.ops.windows import shifted
from torchelev.robot import RobotConfig
from torchelev.traversability.features import Extremes, Surface, mean_of_three, squashed, taps, widened_mean
from torchelev.traversability.stances import Cells, Scales, Stance, Way

if TYPE_CHECKING:
    from jaxtyping import Float


DEPTH = 1e6  # [m] below all ground
LEVEL = 1e-6  # [m per cell] of ground that counts as level
DIAGONAL = math.sqrt(2)  # of a cell


class Attitude(NamedTuple):
    """A body's stance at one heading on four feet, as ratios to the robot's limits.

    0 where the ground that each depends on is not completed: under the feet for slope and step, else under all.
    """

    slope: Float[Tensor, "B H W"]  #: squared gradient of the body; this, step and belly are squashed
    step: Float[Tensor, "B H W"]  #: highest step between neighbouring feet
    belly: Float[Tensor, "B H W"]  #: height of the highest ground under the body over the feet, by the clearance
    stands: Float[Tensor, "B H W"]  #: near 1 where none of these is above the limit, near 0 where one is
    complete: Float[Tensor, "B H W"]  #: 1 or 0: feet and body are over completed ground


class Footing(NamedTuple):
    """Where feet may stand, and what lies between them. Feet: (B, H + 2 foot, W + 2 foot)."""

    height: Tensor  #: [m] of feet
    steepness: Tensor  #: [m per cell] of the ground under feet
    highest: Tensor  #: [m] highest of 3 x 3 cells; far below all ground where it is not completed


def attitudes(
    ground: Surface, extreme: Extremes, scales: Scales, robot: RobotConfig, resolution: float
) -> list[Attitude]:
    """Return how the body stands at each heading."""
    height = shifted(ground.height, scales.margin - scales.foot - 1)
    footing = Footing(
        widened_mean(height, (1,)), _steepness(height, math.tan(robot.max_slope) * resolution), _highest_near(extreme)
    )
    return [_attitude(footing, extreme, stance, scales, robot, resolution) for stance in scales.stances]


def _attitude(
    footing: Footing, extreme: Extremes, stance: Stance, scales: Scales, robot: RobotConfig, resolution: float
) -> Attitude:
    a, b, c, d = (shifted(footing.height, scales.foot, *foot) for foot in stance.feet)
    pitch = (a + b - (c + d)) * (0.5 / (stance.length * resolution))
    roll = (a + c - (b + d)) * (0.5 / (stance.width * resolution))
    inclination = (pitch.square() + roll.square()) * (1 / math.tan(robot.max_slope) ** 2)
    step = _highest_step(footing, stance, scales) * (1 / robot.step_height)
    middle = (a + d + (b + c)) * 0.25
    belly = (_highest(extreme.body, stance, scales, pitch, roll, resolution) - middle) * (1 / robot.clearance)
    whole = functools.reduce(torch.mul, (shifted(extreme.complete, scales.stood_on, *foot) for foot in stance.feet))
    under = functools.reduce(torch.mul, (shifted(extreme.body_complete, scales.spine, *at) for at in stance.spine))
    complete = whole * under
    stands = _below_one(inclination, step.square(), belly.clamp(min=0).square()) * complete
    return Attitude(squashed(inclination) * whole, squashed(step) * whole, squashed(belly) * complete, stands, complete)


def _below_one(*squares: Tensor) -> Tensor:
    """Return the product of 1 / (1 + x^8) over ratios x, of which the squares are given."""
    gates = (1 + square.clamp(max=100).square().square() for square in squares)  # whose product stays finite
    return 1 / functools.reduce(torch.mul, gates)


def _highest_near(extreme: Extremes) -> Tensor:
    """Return the highest ground [m] of 3 x 3 cells, far below all ground where it is not completed."""
    return extreme.near[0] - DEPTH * (1 - extreme.complete)


def _steepness(height: Tensor, steepest: float) -> Tensor:
    """Return the slope [m per cell] around each cell, at most `steepest`; edges beside the cell do not count.

    Along each axis it is the gentler of the slopes to both sides, of rows of three cells, if both rise or both fall.
    """
    return (_gentler(height, -2) + _gentler(height, -1)).clamp(min=LEVEL**2).sqrt().clamp(max=steepest)


def _gentler(height: Tensor, dim: int) -> Tensor:
    """Return the square of the gentler slope along a dimension, of the mean of three rows."""
    before, middle, after = taps(mean_of_three(height, 1, -3 - dim), 1, dim)
    first, second = middle - before, after - middle
    rising, falling = torch.minimum(first, second).clamp(min=0), torch.maximum(first, second).clamp(max=0)
    return rising.square() + falling.square()


def _highest(
    body: Tensor, stance: Stance, scales: Scales, pitch: Tensor, roll: Tensor, resolution: float
) -> Float[Tensor, "B H W"]:
    """Return the highest ground [m] under the body, less the rise by its inclination within each square."""
    middle, front, hind = (shifted(body, scales.spine, *at) for at in stance.spine)
    rise = pitch * (math.hypot(*stance.spine[1]) * resolution)
    steepest = torch.maximum(pitch.abs(), roll.abs()) * DIAGONAL if stance.diagonal else pitch.abs() + roll.abs()
    inclined = steepest * (scales.body * resolution)  # to the corner of a square that does not turn with the body
    return torch.maximum(torch.maximum(front - rise, hind + rise), middle) - inclined


def _highest_step(footing: Footing, stance: Stance, scales: Scales) -> Float[Tensor, "B H W"]:
    """Return the highest step [m] between neighbouring feet, less the rise by the slope under both.

    Holes are stepped over, and each riser of a stair counts by itself.
    """
    steps = [step for way, starts in stance.ways.items() for step in _steps(footing, way, starts, scales)]
    return functools.reduce(torch.maximum, steps).clamp(min=0)


def _steps(footing: Footing, way: Way, starts: list[Cells], scales: Scales) -> list[Float[Tensor, "B H W"]]:
    """Return the step [m] on the way from each start, found once for all places that any of them may lie on."""
    low, high = ([bound(values) for values in zip(*starts, strict=True)] for bound in (min, max))

    def at(values: Tensor, rim: int, place: Cells = (0, 0)) -> Tensor:
        for dim in (0, 1):
            size = values.shape[dim - 2] - 2 * rim + high[dim] - low[dim]
            values = values.narrow(dim - 2, rim + low[dim] + place[dim], size)
        return values

    start, end = at(footing.height, scales.foot), at(footing.height, scales.foot, way.end)
    between = [at(footing.highest, scales.stood_on, place) for place in way.places]
    steepness = torch.minimum(at(footing.steepness, scales.foot), at(footing.steepness, scales.foot, way.end))
    # The highest of 3 x 3 cells lies up to a diagonal farther on.
    step = _unexplained_rise(start, end, between, steepness * (way.spacing + DIAGONAL))
    H, W = (size - 2 * scales.foot for size in footing.height.shape[-2:])
    return [step.narrow(-2, i - low[0], H).narrow(-1, j - low[1], W) for i, j in starts]


def _unexplained_rise(start: Tensor, end: Tensor, between: list[Tensor], explained: Tensor) -> Tensor:
    """Return the larger rise [m] of both directions between two feet, less the rise by the slope."""
    return torch.maximum(_rise([start, *between, end]), _rise([end, *between[::-1], start])) - explained


def _rise(heights: Sequence[Tensor]) -> Tensor:
    """Return max_k (m_k+1 - m_k), the largest rise of m_k = max(h_0, ... h_k), the highest so far."""
    highest = itertools.accumulate(heights, torch.maximum)
    return functools.reduce(torch.maximum, (after - before for before, after in itertools.pairwise(highest)))
