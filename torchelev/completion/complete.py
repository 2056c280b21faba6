"""The completed map: measured cells refined, unknown ones predicted."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.completion import completion_kernel
from torchelev.completion.context import Context, describe, sum_layers
from torchelev.completion.parameters import Weights
from torchelev.completion.predict import Seen, predict
from torchelev.completion.refine import read_measured, refine
from torchelev.completion.surroundings import UNKNOWN, count_steps, look_around
from torchelev.ops.library import operator
from torchelev.ops.parallel import map_in_order

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_AT_A_TIME = 2**13  # unknown cells on a CPU at a time: their intermediate values stay in its caches
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

    Without a known cell in a map, its mean is 0, or the upper bound below it, and its standard deviation the prior's.

    Args:
        weights: parameters.
        layers: the maps.
        resolution: [m].
    """
    if _may_choose_cells(weights, layers):
        return Completion(*complete_on_cpu(list(weights), list(layers), resolution))
    known, cells = layers.validity, Cells(layers, resolution)
    places = torch.arange(known.numel(), device=known.device).split(_AT_A_TIME_ON_GPU)
    parts = [_answer_all(weights, cells, place) for place in places]
    return Completion(*(torch.cat(values).view_as(known) for values in zip(*parts, strict=True)))


def _answer_all(weights: Weights, cells: Cells, place: Tensor) -> list[Tensor]:
    """Return mean and standard deviation of cells, each computed both as measured and as unknown."""
    context, known = cells.describe(place), cells.known.flatten().index_select(0, place)
    measured, unknown = cells.measured.choose(place), cells.read_unknown(place, context)
    answers = zip(refine(weights, measured, context), predict(weights, unknown), strict=True)
    return [torch.where(known, old, new) for old, new in answers]


def _empty_layers(weights: list[Tensor], layers: list[Tensor], resolution: float) -> tuple[Tensor, Tensor]:
    shape = layers[0].shape
    return layers[0].new_empty(shape), layers[0].new_empty(shape)


@operator(
    "complete_on_cpu(Tensor[] weights, Tensor[] layers, float resolution) -> (Tensor, Tensor)", fake=_empty_layers
)
def complete_on_cpu(weights: list[Tensor], layers: list[Tensor], resolution: float) -> tuple[Tensor, Tensor]:
    """Return the same without gradients: in C++ where that can be built, else by tensors."""
    fields, named = Weights(*weights), CompletionInput(*layers)
    fast = completion_kernel.complete(fields, layers, resolution)
    return _answer_each(fields, Cells(named, resolution)) if fast is None else fast


@torch.no_grad()
def _answer_each(weights: Weights, cells: Cells) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation of all cells, as measured or unknown ones, on all cores."""

    def measured(place: Tensor) -> tuple[Tensor, Tensor]:
        return refine(weights, cells.measured.choose(place), cells.describe(place))

    def unknown(place: Tensor) -> tuple[Tensor, Tensor]:
        return predict(weights, cells.read_unknown(place, cells.describe(place)))

    layers = torch.empty_like(cells.ground), torch.empty_like(cells.ground)
    for answer, chosen in ((measured, cells.known), (unknown, ~cells.known)):
        places = chosen.flatten().nonzero()[:, 0].split(_AT_A_TIME)
        for place, values in zip(places, map_in_order(answer, places), strict=True):
            for layer, value in zip(layers, values, strict=True):
                layer.view(-1).index_copy_(0, place, value)
    return layers


class Cells:
    """Gathers the network's inputs at cells of the maps; cells are numbered in the flat maps."""

    def __init__(self, layers: CompletionInput, resolution: float) -> None:
        elevation, known, variance, upper_bound, bounded, age = layers
        bounded = bounded & ~known
        self.known, self.resolution = known, resolution
        self.ground = torch.where(known, elevation, UNKNOWN).contiguous()
        self.steps = count_steps(known)
        total = torch.where(known, elevation, 0.0).double().sum((1, 2))
        self.level = total / known.sum((1, 2)).clamp(min=1)  # [m] where no direction holds known ground
        self.sums = sum_layers(elevation, known, bounded, self.level)
        self.bound, self.bounded = upper_bound.flatten(), bounded.flatten()
        self.measured = read_measured(elevation, known, variance, age, resolution)

    def describe(self, place: Int[Tensor, "n"]) -> Context:
        """Return the squares around cells."""
        return describe(self.sums, self.level, place, self.resolution)

    def read_unknown(self, place: Int[Tensor, "n"], context: Context) -> Seen:
        """Return the network's inputs at unknown cells."""
        around = look_around(self.ground, self.steps, place, self.resolution)
        bound, bounded = (values.index_select(0, place) for values in (self.bound, self.bounded))
        level = self.level.to(bound.dtype).index_select(0, place // self.known[0].numel())
        return Seen(around, context, bound, bounded, level, torch.full_like(bound, self.resolution))


def _may_choose_cells(weights: Weights, layers: CompletionInput) -> bool:
    """Return whether the number of computed cells may depend on the data: on a CPU, without gradients."""
    is_differentiated = torch.is_grad_enabled() and any(value.requires_grad for value in (*weights, *layers))
    return layers.validity.device.type == "cpu" and not is_differentiated
