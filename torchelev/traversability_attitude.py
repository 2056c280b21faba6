"""How a body would stand over every cell at each heading: what the learned head judges a stance by.

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

from torchelev.robot import RobotConfig
from torchelev.traversability_features import Extremes, Surface, squashed, widened_mean
from torchelev.traversability_stances import Scales, Stance, stances
from torchelev.windows import shifted

if TYPE_CHECKING:
    from jaxtyping import Float


class Attitude(NamedTuple):
    """How a body stands at one heading on four feet, by ratios to what the robot overcomes; 0 unless `complete`."""

    slope: Float[Tensor, "B H W"]  # squared gradient of the body; this, step and belly are squashed
    step: Float[Tensor, "B H W"]  # highest step between neighbouring feet
    belly: Float[Tensor, "B H W"]  # height of the highest ground under the body over the feet, by the clearance
    stands: Float[Tensor, "B H W"]  # near 1 where none of these is above the limit, near 0 where one is
    complete: Float[Tensor, "B H W"]  # 1 or 0: feet and body are over completed ground


def attitudes(
    ground: Surface, extreme: Extremes, scales: Scales, robot: RobotConfig, resolution: float
) -> list[Attitude]:
    """Return how the body stands at each heading; slope and step count wherever the feet are on completed ground."""
    height = widened_mean(shifted(ground.height, scales.margin - scales.foot - 1), (1,))
    return [_attitude(height, extreme, stance, scales, robot, resolution) for stance in stances(robot, resolution)]


def _attitude(
    height: Tensor, extreme: Extremes, stance: Stance, scales: Scales, robot: RobotConfig, resolution: float
) -> Attitude:
    feet = [shifted(height, scales.foot, *foot) for foot in stance.feet]
    a, b, c, d = feet
    pitch = (a + b - (c + d)) * (0.5 / (stance.length * resolution))
    roll = (a + c - (b + d)) * (0.5 / (stance.width * resolution))
    slope = (pitch.square() + roll.square()) * (1 / math.tan(robot.max_slope) ** 2)
    step = _highest_step(feet, extreme.near[0], stance, scales) * (1 / robot.step_height)
    middle = (a + d + (b + c)) * 0.25
    belly = (_highest(extreme.body, stance, scales, pitch, roll, resolution) - middle) * (1 / robot.clearance)
    whole = functools.reduce(torch.mul, (shifted(extreme.complete, scales.stood_on, *foot) for foot in stance.feet))
    under = functools.reduce(torch.mul, (shifted(extreme.body_complete, scales.spine, *at) for at in stance.spine))
    complete = whole * under
    stands = _below_one(slope, step.square(), belly.clamp(min=0).square()) * complete
    return Attitude(squashed(slope) * whole, squashed(step) * whole, squashed(belly) * complete, stands, complete)


def _below_one(*squares: Tensor) -> Tensor:
    """Return the product of 1 / (1 + x^8) over ratios x, of which the squares are given."""
    gates = (1 + square.clamp(max=100).square().square() for square in squares)  # whose product stays finite
    return 1 / functools.reduce(torch.mul, gates)


def _highest(
    body: Tensor, stance: Stance, scales: Scales, pitch: Tensor, roll: Tensor, resolution: float
) -> Float[Tensor, "B H W"]:
    """Return the highest ground [m] under the body, less what its inclination explains within each square."""
    middle, front, hind = (shifted(body, scales.spine, *at) for at in stance.spine)
    rise = pitch * (math.hypot(*stance.spine[1]) * resolution)
    inclined = (pitch.abs() + roll.abs()) * (scales.body * resolution)
    return torch.maximum(torch.maximum(front - rise, hind + rise), middle) - inclined


def _highest_step(feet: Sequence[Tensor], highest: Tensor, stance: Stance, scales: Scales) -> Float[Tensor, "B H W"]:
    """Return the highest step [m] on the ways between neighbouring feet, from either to the other.

    Holes are stepped over, and each riser of a stair counts by itself.
    """
    steps = []
    for (start, end), places in stance.ways:
        heights = [feet[start], *(shifted(highest, scales.stood_on, *place) for place in places), feet[end]]
        steps += [_rise(heights), _rise(heights[::-1])]
    return functools.reduce(torch.maximum, steps)


def _rise(heights: Sequence[Tensor]) -> Tensor:
    """Return max_k (m_k+1 - m_k), the largest rise of m_k = max(h_0, ... h_k), the highest so far."""
    highest = itertools.accumulate(heights, torch.maximum)
    return functools.reduce(torch.maximum, (after - before for before, after in itertools.pairwise(highest)))
