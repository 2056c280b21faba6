"""The completed map: measured cells refined, unknown ones predicted."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.completion.context import describe_context
from torchelev.completion.predict import predict
from torchelev.completion.refine import refine
from torchelev.completion.surroundings import count_steps, look_around
from torchelev.completion.parameters import Weights
from torchelev.ops.parallel import map_in_order

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_AT_A_TIME = 2**12  # unknown cells on a CPU: what is computed of them stays in its caches
_AT_A_TIME_ON_GPU = 2**20


class Completion(NamedTuple):
    """The ground at every cell."""

    mean: Float[Tensor, "B H W"]  #: [m]
    std: Float[Tensor, "B H W"]  #: [m] standard deviation


class CompletionInput(NamedTuple):
    """The layers that are completed. Arbitrary but finite where they do not count."""

    elevation: Float[Tensor, "B H W"]  #: [m]
    validity: Bool[Tensor, "B H W"]  #: where the elevation is known
    variance: Float[Tensor, "B H W"]  #: [m^2]
    upper_bound: Float[Tensor, "B H W"]  #: [m]
    bounded: Bool[Tensor, "B H W"]  #: where the upper bound counts, if the cell is not known
    age: Float[Tensor, "B H W"]  #: [s] since the last measurement


def complete(weights: Weights, layers: CompletionInput, resolution: float) -> Completion:
    """Return the mean and the standard deviation of the ground at every cell.

    Without a known cell in a map, its mean is 0 and its standard deviation the prior's.

    Args:
        weights: parameters.
        layers: the maps.
        resolution: [m].
    """
    known, bounded = layers.validity, layers.bounded & ~layers.validity
    mean, std = refine(weights, layers.elevation, known, layers.variance, layers.age, resolution)
    steps = count_steps(known)
    context = describe_context(layers.elevation, known, bounded, resolution).flatten(1)
    level = torch.where(known, layers.elevation, 0.0).sum((1, 2)) / known.sum((1, 2)).clamp(min=1)
    flat_bound, flat_bounded = layers.upper_bound.flatten(), bounded.flatten()
    per_map = known[0].numel()

    def predict_at(place: Int[Tensor, "n"]) -> tuple[Tensor, Tensor]:
        around = look_around(layers.elevation, known, steps, place, resolution)
        bound = (values.index_select(0, place) for values in (flat_bound, flat_bounded))
        at = level.index_select(0, place // per_map)
        return predict(weights, around, context.index_select(1, place), *bound, at, resolution)

    if _may_choose_cells(known):
        unknown = (~known).flatten().nonzero()[:, 0]
        parts = list(map_in_order(predict_at, unknown.split(_AT_A_TIME)))
        for layer, values in zip((mean, std), zip(*parts, strict=True), strict=False):
            layer.view(-1).index_copy_(0, unknown, torch.cat(values))
        return Completion(mean, std)
    places = torch.arange(known.numel(), device=known.device).split(_AT_A_TIME_ON_GPU)
    predicted = (torch.cat(values).view_as(mean) for values in zip(*map(predict_at, places), strict=True))
    return Completion(*(torch.where(known, old, new) for old, new in zip((mean, std), predicted, strict=True)))


def _may_choose_cells(known: Tensor) -> bool:
    """Tell whether the number of computed cells may depend on the data: on a CPU, without gradients and compiler."""
    return known.device.type == "cpu" and not torch.is_grad_enabled() and not torch.compiler.is_compiling()
