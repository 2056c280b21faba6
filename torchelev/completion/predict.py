"""The ground at unknown cells, predicted from the known ground in eight directions."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.completion.context import Context
from torchelev.completion.parameters import USUAL, Weights, affine, hidden, squash
from torchelev.completion.surroundings import Surroundings

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_NOWHERE = 1e6  # [m]
_STEP = 0.1  # [m] distances count about logarithmically beyond it
_FARTHEST = 10.0  # [m] distances beyond it make no difference
_STEEPEST = 1.5  # slope to which ground is continued
_SMALL_STEP = 0.01  # [m] steps count about logarithmically beyond it
_MARGIN = 0.02  # [m] by which an answer may leave the range of the heights around
_NO_SPREAD = 0.01  # [m] of candidates that agree
_FADE = 2.0  # [m] from measurements, where prior and prediction count the same
_NO_VOTE = -1e4  # logit of a candidate that does not exist
_LARGEST_LOG = 5.0  # of the network's factor on a spread


class Seen(NamedTuple):
    """What the prediction at n unknown cells depends on."""

    around: Surroundings  #: the known ground in eight directions
    context: Context  #: the ground in the squares around them
    upper_bound: Float[Tensor, "n"]  #: [m]
    bounded: Bool[Tensor, "n"]  #: where it counts
    level: Float[Tensor, "n"]  #: [m] mean where no direction holds known ground
    resolution: Float[Tensor, "n"]  #: [m]


def predict(weights: Weights, seen: Seen) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Return the mean and the standard deviation [m] of the ground at unknown cells.

    Each direction proposes candidates: the height of the next known cell, that of the line to the opposite one, and
    the continued slopes; each square proposes its mean. The answer is their average by the softmax of the network's
    votes, plus a correction within the range of the heights around, and not above the upper bound. No variance enters:
    to see the same ground again makes no unseen cell surer. Far from known cells, the standard deviation becomes the
    prior's:

        log std = (1 - t) log std_net + t log std_prior,    t = d^2 / (d^2 + 4 m^2).
    """
    around, context, upper_bound, bounded, level, resolution = seen
    known, nowhere = around.is_known, _NOWHERE * (1 - around.is_known)
    has_any = known.amax(0) > 0
    distance = around.distance.clamp(max=_FARTHEST)
    nearest = (distance + nowhere).amin(0).clamp(max=_FARTHEST)
    near = nearest / distance.clamp(min=1e-6) * known

    # Heights from the mean of those around, first from the lowest, so that altitude costs no precision.
    low_height = torch.where(has_any, (around.height + nowhere).amin(0), level)
    height = (around.height - low_height) * known
    mean = (near * height).sum(0) / near.sum(0).clamp(min=1e-6)
    height = (height - mean) * known
    reference = low_height + mean
    low, high = -mean, torch.where(has_any, (height - nowhere).amax(0), 0.0)
    bound = torch.where(bounded, upper_bound - low_height - mean, 0.0)
    is_bounded = bounded.to(bound.dtype)

    both = known * opposite(known)
    share = opposite(distance) / (distance + opposite(distance)).clamp(min=1e-6) * both
    step = (opposite(height) - height) * both
    slopes, has_slope = around.slope.clamp(-_STEEPEST, _STEEPEST), around.has_slope
    features = [known, near, torch.log1p(distance / _STEP), squash(height), squash(height - low) * known]
    features += [both, share, squash(step), *has_slope, *slopes]
    views = hidden(weights.view, torch.stack(features), weights.view_bias)
    views = hidden(weights.view_inner, views, weights.view_inner_bias)

    cell = [squash(high - low), squash(low), is_bounded, squash(bound - low) * is_bounded, squash(bound)]
    cell += [torch.log1p(nearest / _STEP), (resolution / USUAL).log(), known.mean(0)]
    ground = (context.mean - low_height - mean) * (context.known > 0)
    known_share, bounded_share, steps, ground, stds, skewness = (
        values.to(bound.dtype) for values in context._replace(mean=ground)
    )
    cell += torch.cat([known_share, bounded_share, squash(steps, _SMALL_STEP), squash(ground)]).unbind()
    cell += torch.cat([squash(stds), skewness]).unbind()
    pooled = torch.cat([views.mean(1), views.amax(1), torch.stack(cell)])
    cells = hidden(weights.cell, pooled, weights.cell_bias)
    cells = hidden(weights.cell_inner, cells, weights.cell_inner_bias)

    views = torch.relu(views + affine(weights.to_view, cells, weights.to_view_bias)[:, None])
    votes = (weights.vote @ views.flatten(1)).unflatten(1, known.shape)
    votes = votes + affine(weights.vote_cell, cells, weights.vote_bias)[:, None]
    proposed = torch.cat([torch.stack([known, both]), has_slope])
    candidates = torch.cat([torch.stack([height, height + (1 - share) * step]), height + slopes * distance])
    votes = torch.cat([votes.flatten(0, 1), affine(weights.vote_square, cells, weights.vote_square_bias)])
    proposed = torch.cat([proposed.flatten(0, 1), (known_share > 0).to(votes.dtype)])
    candidates = torch.cat([candidates.flatten(0, 1), ground])
    ballot = (votes * proposed + _NO_VOTE * (1 - proposed)).softmax(0)
    answer = (ballot * candidates).sum(0)
    spread = (ballot * (candidates - answer).square()).sum(0) + _NO_SPREAD**2

    correction, factor = affine(weights.answer, cells, weights.answer_bias)
    answer = torch.where(has_any, answer + torch.tanh(correction) * (high - low + _MARGIN), 0.0)
    answer = torch.where(bounded, torch.minimum(answer, bound), answer)
    log_std = 0.5 * spread.log() + factor.clamp(-_LARGEST_LOG, _LARGEST_LOG) + weights.calibration[0]
    reach = (around.distance + nowhere).amin(0).square()
    fade = reach / (reach + _FADE**2)
    std = torch.exp((1 - fade) * log_std + fade * weights.prior)
    return reference + answer, torch.where(has_any, std, weights.prior.exp())


def opposite(values: Float[Tensor, "8 n"]) -> Float[Tensor, "8 n"]:
    """Return for each direction the value of the opposite one."""
    return values.view(4, 2, -1).flip(1).view_as(values)
