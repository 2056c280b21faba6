"""The ground at measured cells: their elevation, drawn towards their neighbours within its own uncertainty."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.completion.context import Context
from torchelev.completion.parameters import SMALL_STEP, USUAL, Weights, affine, describe_context, hidden, squash
from torchelev.ops.windows import neighbours

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_PAIRS = ((0, 7), (1, 6), (2, 5), (3, 4))  # opposite ones of `neighbours`
MIN_STD = 1e-3  # [m]
LONG_AGO = 60.0  # [s] ages count about logarithmically beyond a second, up to this


class Measured(NamedTuple):
    """n measured cells and their neighbours; arbitrary but finite where a cell is not measured."""

    height: Float[Tensor, "n"]  #: [m]
    sigma: Float[Tensor, "n"]  #: [m] standard deviation of it in the map, MIN_STD at least
    bend: Float[Tensor, "n"]  #: [m] mean height of the lines through opposite neighbours, above the cell
    features: Float[Tensor, "F n"]  #: of the network

    def choose(self, place: Int[Tensor, "k"]) -> Measured:
        """Return some of the cells, by number."""
        return Measured(*(value.index_select(-1, place) for value in self))


def read_measured(
    elevation: Float[Tensor, "B H W"],
    known: Bool[Tensor, "B H W"],
    variance: Float[Tensor, "B H W"],
    age: Float[Tensor, "B H W"],
    resolution: float,
) -> Measured:
    """Return all cells of the maps, n = B * H * W of them."""
    height = torch.where(known, elevation, 0.0)
    around, has = neighbours(height, 0.0), neighbours(known.to(height.dtype), 0.0)
    pairs = [has[a] * has[b] * known for a, b in _PAIRS]
    bends = [p * (0.5 * ((around[a] - height) + (around[b] - height))) for p, (a, b) in zip(pairs, _PAIRS, strict=True)]
    tilts = [p * (around[a] - around[b]).abs() for p, (a, b) in zip(pairs, _PAIRS, strict=True)]
    count = sum_in_pairs(pairs)
    bend, rough, tilt = (
        sum_in_pairs(values) / count.clamp(min=1) for values in (bends, [bend.abs() for bend in bends], tilts)
    )
    sigma = torch.where(known, variance, 0.0).clamp(min=MIN_STD**2).sqrt()
    features = [sigma.log(), bend.abs() / (bend.abs() + sigma), squash(rough, SMALL_STEP), squash(tilt), count / 4]
    features += [torch.log1p(torch.where(known, age, 0.0).clamp(0, LONG_AGO))]
    features += [torch.full_like(sigma, math.log(resolution / USUAL))]
    return Measured(height.flatten(), sigma.flatten(), bend.flatten(), torch.stack(features).flatten(1))


def refine(weights: Weights, cells: Measured, context: Context) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Return the mean and the standard deviation [m] of the ground at measured cells.

    The line through two opposite neighbours passes the cell at some height; u is the mean of these heights less the
    cell's elevation h, over the pairs that are known. With the network's gain g in [0, 1],

        mean = h + 2 sigma tanh(g u / (2 sigma)),

    which stays within two standard deviations sigma of the map, a millimetre at least. The squares around a cell
    determine how far to trust it: where there are many gaps, a pose that is off by a few centimetres puts ground into
    a gap.
    """
    height, sigma, bend, features = cells
    squares = ((context.mean - height) * (context.known > 0)).to(height.dtype)
    features = torch.cat([features, describe_context(context, squares)])
    channels = hidden(weights.measured, features, weights.measured_bias)
    gain, factor = affine(weights.measured_answer, channels, weights.measured_answer_bias)
    mean = height + 2 * sigma * torch.tanh(torch.sigmoid(gain) * bend / (2 * sigma))
    std = (sigma.square() + torch.exp(2 * factor.clamp(-10.0, 2.0))).sqrt() * weights.calibration[1].exp()
    return mean, std


def sum_in_pairs(values: list[Tensor]) -> Tensor:
    """Return the sum of four values, to the bit the same when a turn or mirror exchanges two axes or diagonals."""
    diagonal, along_x, other_diagonal, along_y = values
    return (diagonal + other_diagonal) + (along_x + along_y)
