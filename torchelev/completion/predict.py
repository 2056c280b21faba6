"""The ground at unknown cells, predicted from the known ground in eight directions."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.completion.context import Context
from torchelev.completion.parameters import USUAL, Weights, affine, describe_context, hidden, squash
from torchelev.completion.surroundings import Surroundings

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

NOWHERE = 1e6  # [m]
STEP = 0.1  # [m] distances count about logarithmically beyond it
FARTHEST = 10.0  # [m] distances beyond it make no difference
STEEPEST = 1.5  # slope to which ground is continued
MARGIN = 0.02  # [m] by which an answer may leave the range of the heights around
NO_SPREAD = 0.01  # [m] of candidates that agree
FADE = 2.0  # [m] from measurements, where prior and prediction count the same
NO_VOTE = -1e4  # logit of a candidate that does not exist
LARGEST_LOG = 5.0  # of the network's factor on a spread


class Seen(NamedTuple):
    """Inputs of the prediction at n unknown cells."""

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
    heights = _relate(seen)
    proposals = _propose(seen.around, heights)
    views = hidden(weights.view, proposals.features, weights.view_bias)
    views = hidden(weights.view_inner, views, weights.view_inner_bias)
    pooled = torch.cat([views.mean(1), views.amax(1), _describe_cell(seen, heights)])
    cells = hidden(weights.cell, pooled, weights.cell_bias)
    cells = hidden(weights.cell_inner, cells, weights.cell_inner_bias)
    answer, spread = _vote(weights, views, cells, proposals, heights)

    correction, factor = affine(weights.answer, cells, weights.answer_bias)
    has_any, bounded = heights.has_any, seen.bounded
    answer = answer + torch.tanh(correction) * (heights.high - heights.low + MARGIN)
    answer = torch.where(has_any, answer, 0.0)
    answer = torch.where(bounded, torch.minimum(answer, heights.bound), answer)
    log_std = 0.5 * spread.log() + factor.clamp(-LARGEST_LOG, LARGEST_LOG) + weights.calibration[0]
    reach = heights.reach.square()
    fade = reach / (reach + FADE**2)
    std = torch.exp((1 - fade) * log_std + fade * weights.prior)
    return heights.reference + answer, torch.where(has_any, std, weights.prior.exp())


class _Heights(NamedTuple):
    """Heights [m] from the mean of those around each cell, in which nearer ones count more."""

    has_any: Bool[Tensor, "n"]  # a direction holds known ground
    reference: Float[Tensor, "n"]  # what they count from
    height: Float[Tensor, "8 n"]  # of the next known cells
    low: Float[Tensor, "n"]  # lowest of these
    high: Float[Tensor, "n"]  # highest of these
    bound: Float[Tensor, "n"]  # upper bound, 0 where there is none
    squares: Float[Tensor, "R n"]  # means of the squares, 0 where there is none
    has_square: Float[Tensor, "R n"]  # 1 where there is one, else 0
    distance: Float[Tensor, "8 n"]  # [m] of the next known cells, FARTHEST at most
    reach: Float[Tensor, "n"]  # [m] of the nearest of these
    near: Float[Tensor, "8 n"]  # nearest distance over that of each


class _Proposals(NamedTuple):
    """Features and proposed heights of each direction."""

    features: Float[Tensor, "F 8 n"]
    candidates: Float[Tensor, "V 8 n"]  # [m]
    exists: Float[Tensor, "V 8 n"]  # 1 or 0


def _relate(seen: Seen) -> _Heights:
    around, context, known = seen.around, seen.context, seen.around.is_known
    nowhere, has_any = NOWHERE * (1 - known), known.amax(0) > 0
    distance = around.distance.clamp(max=FARTHEST)
    reach = (around.distance + nowhere).amin(0)
    nearest = reach.clamp(max=FARTHEST)
    near = nearest / distance.clamp(min=1e-6) * known
    # First from the lowest, so that altitude costs no precision.
    lowest = torch.where(has_any, (around.height + nowhere).amin(0), seen.level)
    height = (around.height - lowest) * known
    mean = (near * height).sum(0) / near.sum(0).clamp(min=1e-6)
    height = (height - mean) * known
    high = torch.where(has_any, (height - nowhere).amax(0), 0.0)
    bound = torch.where(seen.bounded, seen.upper_bound - lowest - mean, 0.0)
    has_square = (context.known > 0).to(bound.dtype)
    squares = (context.mean - lowest - mean).to(bound.dtype) * has_square
    return _Heights(has_any, lowest + mean, height, -mean, high, bound, squares, has_square, distance, reach, near)


def _propose(around: Surroundings, heights: _Heights) -> _Proposals:
    known, distance, height = around.is_known, heights.distance, heights.height
    both = known * opposite(known)
    share = opposite(distance) / (distance + opposite(distance)).clamp(min=1e-6) * both
    step = (opposite(height) - height) * both
    slopes = around.slope.clamp(-STEEPEST, STEEPEST)
    features = [known, heights.near, torch.log1p(distance / STEP)]
    features += [squash(height), squash(height - heights.low) * known, both, share, squash(step)]
    candidates = torch.cat([torch.stack([height, height + (1 - share) * step]), height + slopes * distance])
    exists = torch.cat([torch.stack([known, both]), around.has_slope])
    return _Proposals(torch.stack([*features, *around.has_slope, *slopes]), candidates, exists)


def _describe_cell(seen: Seen, heights: _Heights) -> Float[Tensor, "F n"]:
    low, high, bound, is_bounded = heights.low, heights.high, heights.bound, seen.bounded.to(heights.bound.dtype)
    cell = [squash(high - low), squash(low), is_bounded, squash(bound - low) * is_bounded, squash(bound)]
    cell += [
        torch.log1p(heights.reach.clamp(max=FARTHEST) / STEP),
        (seen.resolution / USUAL).log(),
        seen.around.is_known.mean(0),
    ]
    return torch.cat([torch.stack(cell), describe_context(seen.context, heights.squares)])


def _vote(
    weights: Weights, views: Tensor, cells: Tensor, proposals: _Proposals, heights: _Heights
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Return the mean of the candidates [m] by the network's votes, and their variance [m^2]."""
    views = torch.relu(views + affine(weights.to_view, cells, weights.to_view_bias)[:, None])
    votes = (weights.vote @ views.flatten(1)).unflatten(1, heights.height.shape)
    votes = votes + affine(weights.vote_cell, cells, weights.vote_bias)[:, None]
    votes = torch.cat([votes.flatten(0, 1), affine(weights.vote_square, cells, weights.vote_square_bias)])
    exists = torch.cat([proposals.exists.flatten(0, 1), heights.has_square])
    candidates = torch.cat([proposals.candidates.flatten(0, 1), heights.squares])
    ballot = (votes * exists + NO_VOTE * (1 - exists)).softmax(0)
    answer = (ballot * candidates).sum(0)
    return answer, (ballot * (candidates - answer).square()).sum(0) + NO_SPREAD**2


def opposite(values: Float[Tensor, "8 n"]) -> Float[Tensor, "8 n"]:
    """Return for each direction the value of the opposite one."""
    return values.view(4, 2, -1).flip(1).view_as(values)
