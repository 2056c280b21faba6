"""Inputs of the learned head: the map's surface, completed and made dimensionless by the robot's sizes.

Windows are squares whose radii are lengths of the robot in whole cells. Everything is computed on the map with a rim
of unknown cells around it, which each window eats a part of, so that the rim of a map is unknown ground and no more.
All is unchanged when the map is turned by 90 degrees or mirrored: windows are symmetric, gradients enter as squares.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.ops.windows import padded, shifted
from torchelev.robot import RobotConfig
from torchelev.traversability.stances import Scales

if TYPE_CHECKING:
    from jaxtyping import Float

QUARTER = 0.25  # share of known cells from which a window's mean counts in full
NOISE = 0.02  # [m] standard deviation of heights at which a map counts as noisy
NUM_FEATURES = 18
TINY = 1e-9  # below any window's share of known cells but 0
LARGE = 1e6  # ratio whose square is finite


# Windows ------------------------------------------------------------------------------------------------------------


def taps(values: Tensor, step: int, dim: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return three views along a dimension, `step` entries apart, which is 2 * step shorter."""
    size = values.shape[dim] - 2 * step
    before, middle, after = (values.narrow(dim, k * step, size) for k in range(3))
    return before, middle, after


def mean_of_three(values: Tensor, step: int, dim: int) -> Tensor:
    """Return the mean of three entries along a dimension, `step` apart."""
    before, middle, after = taps(values, step, dim)
    return (before + after + middle) * (1 / 3)


def widened_mean(values: Tensor, steps: Sequence[int]) -> Tensor:
    """Return the mean of 3 x 3 entries a step apart, of that the mean of those the next step apart, and so on."""
    for step in steps:
        values = mean_of_nine(values, step)
    return values


def mean_of_nine(values: Tensor, step: int) -> Tensor:
    """Return the mean of 3 x 3 entries `step` apart."""
    return mean_of_three(mean_of_three(values, step, -2), step, -1)


def widened_maximum(values: Tensor, steps: Sequence[int]) -> Tensor:
    """Return the highest of 3 x 3 entries a step apart, of that the highest of those the next step apart, and so on."""
    for step in steps:
        values = highest_of_nine(values, step)
    return values


def highest_of_nine(values: Tensor, step: int) -> Tensor:
    """Return the highest of 3 x 3 entries `step` apart."""
    for dim in (-2, -1):
        before, middle, after = taps(values, step, dim)
        values = torch.maximum(torch.maximum(before, after), middle)
    return values


# The surface --------------------------------------------------------------------------------------------------------


class Surface(NamedTuple):
    """The ground around every cell and the cells of the margin, unknown ones completed. Heights from the map's mean."""

    height: Float[Tensor, "B h w"]  #: [m]
    known: Float[Tensor, "B h w"]  #: 1 or 0
    shares: list[Tensor]  #: (B, h, w) of known cells in each window
    means: list[Tensor]  #: (B, h, w) [m] of each window, blended with the next where it knows little
    hidden: Float[Tensor, "B h w"]  #: [m] depth of the upper bound below the completed ground
    bounded: Float[Tensor, "B h w"]  #: 1 or 0, of unknown cells
    variance: Float[Tensor, "B h w"]  #: [m^2] mean of the known ones of 3 x 3 cells


def complete(
    elevation: Tensor, validity: Tensor, variance: Tensor, upper_bound: Tensor, bounded: Tensor, scales: Scales
) -> Surface:
    """Fill unknown cells with the mean of the smallest window with enough known cells, not above the upper bound.

    Where no window knows anything, the height is 0.
    """
    known, unseen = validity.to(elevation.dtype), (bounded & ~validity).to(elevation.dtype)
    # Heights from the map's mean, so that altitude costs no precision.
    height = torch.where(validity, elevation, 0.0)
    datum = (height.sum((1, 2), keepdim=True) / known.sum((1, 2), keepdim=True).clamp(min=1)).detach()
    noise = torch.where(validity, variance, 0.0)
    bound = torch.where(bounded, upper_bound - datum, 0.0)
    layers = torch.stack([known, (height - datum) * known, noise, bound, unseen])
    layers = padded(layers, scales.rim, 0.0)

    shares, means, noise = _windows(layers[:3], scales)
    inner = shifted(layers, scales.radii[-1])
    known, height, bound, unseen = inner[0], inner[1], inner[3], inner[4]
    means = blend(shares, means)
    hidden, height = fill(height, known, means[0], bound, unseen * (shares[-1] > 0))
    return Surface(height, known, shares, means, hidden, unseen, noise)


def blend(shares: list[Tensor], means: list[Tensor]) -> list[Tensor]:
    """Return each window's mean, blended with that of the next larger one where few of its cells are known."""
    means = list(means)
    for k in (2, 1, 0):
        means[k] = means[k + 1] + (shares[k] * (1 / QUARTER)).clamp(max=1) * (means[k] - means[k + 1])
    return means


def fill(height: Tensor, known: Tensor, mean: Tensor, bound: Tensor, is_bounded: Tensor) -> tuple[Tensor, Tensor]:
    """Fill unknown cells with the mean [m], not above their bound; return also how far below the mean it is [m]."""
    hidden = (mean - bound).clamp(min=0) * is_bounded
    return hidden, height + (mean - hidden) * (1 - known)


def _windows(layers: Tensor, scales: Scales) -> tuple[list[Tensor], list[Tensor], Tensor]:
    """Return each window's share of known cells and their mean height, and the mean variance of the smallest one."""
    shares, means, noise = [], [], layers[2]
    for number, (steps, radius) in enumerate(zip(scales.steps, scales.radii, strict=True)):
        layers = widened_mean(layers, steps)
        inner = shifted(layers, scales.radii[-1] - radius)
        inverse = 1 / inner[0].clamp(min=TINY)
        shares.append(inner[0])
        means.append(inner[1] * inverse)
        if number == 0:
            noise = inner[2] * inverse
            layers = layers[:2]
    return shares, means, noise


# Features -----------------------------------------------------------------------------------------------------------


class Extremes(NamedTuple):
    """Of the windows around every cell that feet may stand on, and of the body's window around every cell."""

    near: tuple[Tensor, Tensor]  #: (B, h, w) [m] highest and lowest of 3 x 3 cells
    far: tuple[Tensor, Tensor]  #: (B, h, w) [m] of a foot's reach
    complete: Float[Tensor, "B h w"]  #: 1 or 0: all of a foot's reach is completed ground
    body: Float[Tensor, "B h' w'"]  #: [m] highest of half the body's width
    body_complete: Float[Tensor, "B h' w'"]  #: 1 or 0


def extremes(ground: Surface, scales: Scales) -> Extremes:
    """Find the highest and lowest ground of each window."""
    missing = (ground.shares[-1] <= 0).to(ground.height.dtype)
    near = widened_maximum(torch.stack([ground.height, -ground.height, missing]), scales.steps[0])
    far = widened_maximum(near, scales.steps[1])
    body = widened_maximum(far[::2], scales.steps[2])
    rim = scales.margin - scales.stood_on
    near, far = shifted(near, rim - 1), shifted(far, rim - scales.reach)
    body = shifted(body, scales.margin - scales.spine - scales.body)
    return Extremes((near[0], -near[1]), (far[0], -far[1]), 1 - far[2], body[0], 1 - body[1])


def squashed(ratio: Tensor) -> Tensor:
    """Return x |x| / (1 + x^2): steep at 1, where a robot's limits are; outliers count for at most 1."""
    ratio = ratio.clamp(-LARGE, LARGE)
    square = ratio * ratio.abs()
    return square / (1 + square.abs())


def _slope(height: Tensor, distance: int, rim: int) -> Tensor:
    """Return the squared gradient [m^2 per cell^2] between places `distance` cells to both sides."""
    gx, gy = (shifted(height, rim, i, j) - shifted(height, rim, -i, -j) for i, j in ((distance, 0), (0, distance)))
    return (gx.square() + gy.square()) * (0.5 / distance) ** 2


def features(
    ground: Surface, extreme: Extremes, scales: Scales, resolution: float, robot: RobotConfig
) -> list[Float[Tensor, "B h w"]]:
    """Return the features around every cell that feet may stand on; 0 where nothing is known within reach."""
    rim = scales.margin - scales.stood_on
    step, steep = 1 / robot.step_height, (1 / (resolution * math.tan(robot.max_slope))) ** 2
    inner = [shifted(layer, rim) for layer in (ground.height, *ground.means)]
    slopes = [_slope(mean, d, rim) * steep for mean, d in ((ground.means[0], 1), (ground.means[1], scales.reach))]
    heights = [above - below for above, below in itertools.pairwise(inner)]
    for (highest, lowest), mean in ((extreme.near, inner[1]), (extreme.far, inner[2])):
        heights += [highest - mean, mean - lowest]
    return [
        shifted(ground.known, rim),
        *(shifted(share, rim) for share in ground.shares),
        *(squashed(height * step) * extreme.complete for height in heights),
        *(squashed(slope) * extreme.complete for slope in slopes),
        squashed(shifted(ground.variance, rim) * (1 / NOISE**2)),
        squashed(shifted(ground.hidden, rim) * step),
        shifted(ground.bounded, rim),
    ]
