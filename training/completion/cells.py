"""The cells of training: the network's inputs, and the true ground."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from torchelev.completion.complete import Cells, CompletionInput
from torchelev.completion.context import Context
from torchelev.completion.predict import Seen
from torchelev.completion.refine import Measured
from torchelev.completion.surroundings import UNKNOWN, count_steps, look_around
from torchelev.errors import require
from torchelev.filters import Filter
from training.completion.maps import TrueMap

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

NUM_UNKNOWN, NUM_MEASURED = 768, 192  # cells of each map, at most
_NEAR = 0.3  # [m] unknown cells are drawn with a probability of 1 / (distance + this)
FARTHEST = 3.0  # [m] from known cells, of unknown ones
MIN_ERROR = 0.005  # [m] added to the error by which errors are divided
_SHARE = 0.01  # of the unknown cells, to calibrate with
_KEPT = (0.05, 0.6)  # share of the cells that thinned maps keep
_RAISED = (0.03, 3.0)  # [m] by which bounds are raised


class UnknownCells(NamedTuple):
    """n unknown cells."""

    seen: Seen
    truth: Float[Tensor, "n"]  #: [m]
    weight: Float[Tensor, "n"]  #: [1/m] of an error


class MeasuredCells(NamedTuple):
    """n measured cells."""

    seen: Measured
    context: Context
    truth: Float[Tensor, "n"]  #: [m]
    weight: Float[Tensor, "n"]  #: [1/m] of an error


def remove_cells(layers: CompletionInput, kept: Bool[Tensor, "B H W"]) -> CompletionInput:
    """Make the known cells that are not kept unknown, without a bound, as if no view had seen them."""
    lost = layers.validity & ~kept
    return layers._replace(validity=layers.validity & kept, bounded=layers.bounded & ~lost)


def thin_out(layers: CompletionInput, generator: torch.Generator) -> CompletionInput:
    """Keep a random share of each map's known cells, as of a sensor with few rays; bound the others by their height."""
    share = _KEPT[0] + (_KEPT[1] - _KEPT[0]) * torch.rand(len(layers.validity), 1, 1, generator=generator)
    kept = torch.rand(layers.validity.shape, generator=generator) < share
    lost = layers.validity & ~kept
    bound = torch.where(lost, layers.elevation, layers.upper_bound)
    return layers._replace(validity=layers.validity & kept, upper_bound=bound, bounded=layers.bounded | lost)


def vary_bounds(layers: CompletionInput, generator: torch.Generator) -> CompletionInput:
    """Raise the bounds of some maps, as of a higher sensor, and drop those of others."""
    draw, size = torch.rand(2, len(layers.bounded), 1, 1, generator=generator)
    low, high = map(math.log, _RAISED)
    rise = torch.where(draw < 0.4, torch.exp(low + (high - low) * size), 0.0)
    return layers._replace(upper_bound=layers.upper_bound + rise, bounded=layers.bounded & (draw < 0.75))


def distances(maps: TrueMap) -> Float[Tensor, "B H W"]:
    """Return the distance [m] of the nearest known cell in eight directions: 0 where known, inf without one."""
    known = maps.layers.validity
    ground, place = torch.where(known, 0.0, UNKNOWN), torch.arange(known.numel())
    around = look_around(ground, count_steps(known), place, maps.resolution)
    nearest = torch.where(around.is_known > 0, around.distance, torch.inf).amin(0)
    return torch.where(known, 0.0, nearest.view(known.shape))


def draw_unknown(maps: TrueMap, generator: torch.Generator) -> list[UnknownCells]:
    """Draw unknown cells of each map, the more the nearer to known ground.

    Errors weigh by the inverse of the mean error of the nearest known heights in the same map, so that each map counts
    the same, however deep its holes.
    """
    drawn, cells, known = [], Cells(maps.layers, maps.resolution), maps.layers.validity
    filled, _ = Filter("inpaint_nearest")((maps.layers.elevation, known), resolution=maps.resolution)
    distance = distances(maps)
    counts = maps.is_inside & ~known & (distance < FARTHEST)
    for b in range(len(known)):
        place = b * known[0].numel() + counts[b].flatten().nonzero()[:, 0]
        if not len(place):
            continue
        chosen = place[_draw(1 / (distance.flatten()[place] + _NEAR), NUM_UNKNOWN, generator)]
        truth = maps.truth.flatten()[chosen]
        error = (filled.flatten()[chosen] - truth).abs().mean() + MIN_ERROR
        drawn.append(UnknownCells(_look(cells, chosen), truth, torch.full_like(truth, 1 / float(error))))
    return drawn


def draw_evenly(maps: TrueMap, generator: torch.Generator) -> list[UnknownCells]:
    """Draw a fixed share of the unknown cells, each with the same probability and weight, to calibrate with."""
    counts = maps.is_inside & ~maps.layers.validity & (distances(maps) < FARTHEST)
    counts &= torch.rand(counts.shape, generator=generator) < _SHARE
    chosen = counts.flatten().nonzero()[:, 0]
    truth = maps.truth.flatten()[chosen]
    if not len(chosen):
        return []
    seen = _look(Cells(maps.layers, maps.resolution), chosen)
    return [UnknownCells(seen, truth, torch.ones_like(truth))]


def _look(cells: Cells, chosen: Int[Tensor, "n"]) -> Seen:
    return cells.read_unknown(chosen, cells.describe(chosen))


def draw_measured(maps: TrueMap, generator: torch.Generator) -> list[MeasuredCells]:
    """Draw measured cells of each map. Errors weigh by the inverse of the mean error of the map's own elevation."""
    cells, drawn = Cells(maps.layers, maps.resolution), []
    counts, error = maps.is_inside & maps.layers.validity, maps.layers.elevation - maps.truth
    for b in range(len(counts)):
        place = b * counts[0].numel() + counts[b].flatten().nonzero()[:, 0]
        if not len(place):
            continue
        chosen = place[_draw(torch.ones(len(place)), NUM_MEASURED, generator)]
        truth = maps.truth.flatten()[chosen]
        weight = torch.full_like(truth, 1 / float(error.flatten()[chosen].abs().mean() + MIN_ERROR))
        drawn.append(MeasuredCells(cells.measured.choose(chosen), cells.describe(chosen), truth, weight))
    return drawn


def _draw(weights: Tensor, number: int, generator: torch.Generator) -> Tensor:
    return torch.multinomial(weights, min(number, len(weights)), generator=generator)


Drawn = TypeVar("Drawn", UnknownCells, MeasuredCells)


def concatenate(parts: Sequence[Drawn]) -> Drawn:
    """Concatenate cells. Raises ValueError without any."""
    require(len(parts) > 0, "walks", "must hold cells to train on", "none", "give more of them")
    return _map(lambda *values: torch.cat(values, -1), *parts)


def choose(cells: Drawn, chosen: Int[Tensor, "k"]) -> Drawn:
    """Return some of the cells, by number."""
    return _map(lambda value: value.index_select(-1, chosen), cells)


def _map(function: Callable[..., Tensor], *values: Any) -> Any:
    """Apply a function to the tensors of nested tuples of the same kind."""
    if isinstance(values[0], Tensor):
        return function(*values)
    return type(values[0])(*(_map(function, *column) for column in zip(*values, strict=True)))
