"""The learned head as a pure function of its weights and the map's layers."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.ops.windows import shifted
from torchelev.robot import RobotConfig
from torchelev.traversability.attitude import attitudes
from torchelev.traversability.features import complete, extremes, features, widened_maximum
from torchelev.traversability.stances import Scales, in_cells
from torchelev.traversability.trained_range import conditions
from torchelev.traversability.weight_file import Weights

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


def _condition(bias: Float[Tensor, "O"], weight: Float[Tensor, "O N"], values: list[float]) -> Float[Tensor, "O"]:
    """Return bias + weight @ values."""
    for column, value in zip(weight.unbind(1), values, strict=True):
        bias = torch.add(bias, column, alpha=value)  # a constant of a compiled graph, where a tensor would be copied
    return bias  # else every cell would compute it again


def _mix(
    weight: Float[Tensor, "O C"], layers: Sequence[Tensor], bias: Float[Tensor, "O"] | None = None
) -> Float[Tensor, "B O H W"]:
    """Return weight @ layers + bias in every cell, for C layers (B, H, W): a 1 x 1 convolution."""
    values = torch.stack(tuple(layers), 1)
    mixed = torch.bmm(weight.expand(len(values), -1, -1), values.flatten(2)).unflatten(2, values.shape[2:])
    return mixed if bias is None else mixed + bias[:, None, None]


def _mix_few(weight: Float[Tensor, "O C"], values: Sequence[Tensor]) -> Float[Tensor, "B O H W"]:
    """Return the same as `_mix` without copying the layers, which is faster for few of them."""
    columns = zip(weight.unbind(1), values, strict=True)
    return functools.reduce(torch.add, (column[:, None, None] * value[:, None] for column, value in columns))


def min_in_reach(cell: Tensor, scales: Scales) -> Tensor:
    """Return the minimum of each channel over the cells that a foot may step on instead of this one."""
    return -widened_maximum(-cell, (*scales.steps[0], *scales.steps[1]))


def _add_feet(feet: list[Tensor]) -> Tensor:
    """Return the sum of four feet, to the bit the same when a turn or mirror exchanges a with d, or b with c."""
    a, b, c, d = feet
    return (a + d) + (b + c)


def rate(
    weights: Weights,
    elevation: Float[Tensor, "B H W"],
    validity: Bool[Tensor, "B H W"],
    variance: Float[Tensor, "B H W"],
    upper_bound: Float[Tensor, "B H W"],
    bounded: Bool[Tensor, "B H W"],
    *,
    resolution: float,
    robot: RobotConfig,
) -> tuple[Float[Tensor, "B H W"], Float[Tensor, "B H W"]]:
    """Return the logits of traversability and of its confidence, in float32 or float64.

    A first layer describes every cell by the ground around it. A second layer rates a body centred on the cell, at four
    headings: by the cells under its feet and its centre, and by its attitude, which is slope, step and belly. A third
    layer rates the cell by the mean over the headings.

    Args:
        weights: parameters of the layers.
        elevation: [m], arbitrary but finite where not valid.
        validity: True where the elevation is known.
        variance: [m^2] of the elevation.
        upper_bound: [m] of the ground where the elevation is unknown, arbitrary where not bounded.
        bounded: True where the upper bound is known.
        resolution: [m].
        robot: its sizes make windows and heights dimensionless.
    """
    dtype = torch.promote_types(elevation.dtype, torch.float32)  # half precision cannot hold the fractions of windows
    weights = Weights(*(weight.to(dtype) for weight in weights))
    elevation, variance, upper_bound = (layer.to(dtype) for layer in (elevation, variance, upper_bound))
    scales = in_cells(robot, resolution)
    ground = complete(elevation, validity, variance, upper_bound, bounded, scales)
    extreme = extremes(ground, scales)
    sizes = conditions(robot, resolution)

    seen = features(ground, extreme, scales, resolution, robot)
    cell = F.relu(_mix(weights.cell, seen, _condition(weights.cell_bias, weights.cell_condition, sizes)))
    around = [*shifted(cell, scales.reach).unbind(1), *min_in_reach(cell.chunk(2, 1)[0], scales).unbind(1)]
    foot, around = _mix(weights.foot, around), [shifted(layer, scales.foot) for layer in around]
    center = _mix(weights.center, around, _condition(weights.stance_bias, weights.stance_condition, sizes))

    total = torch.zeros_like(center)
    headings = attitudes(ground, extreme, scales, robot, resolution)
    for stance, attitude in zip(scales.stances, headings, strict=True):
        feet = _add_feet([shifted(foot, scales.foot, *place) for place in stance.feet])
        body = _mix_few(weights.attitude, (attitude.slope, attitude.step, attitude.belly))
        total = total + F.relu(feet + center + body)
    each = 1 / len(scales.stances)
    columns = zip(*((attitude.stands, attitude.complete) for attitude in headings), strict=True)
    stands, is_complete = (functools.reduce(torch.add, column) * each for column in columns)
    mixed = F.relu(_mix(weights.mixed, [*(total * each).unbind(1), stands, is_complete], weights.mixed_bias))
    traversability, confidence = _mix(weights.answer, mixed.unbind(1), weights.answer_bias).unbind(1)
    return traversability, confidence
