"""The completed map: what a network predicts of the ground that no sensor saw (`torchelev.completion`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.completion.config import CompletionConfig
from torchelev.errors import require
from torchelev.grid import GridConfig
from torchelev.layers import Layer, pose_variance
from torchelev.ops.moving import move_layers
from torchelev.state import BLANK, MapState

if TYPE_CHECKING:
    from jaxtyping import Bool

    from torchelev.completion.complete import Completion
    from torchelev.completion.net import CompletionNet
    from torchelev.completion.parameters import Weights

COMPLETED = ("completed", "completed_std")  # names of the layers
WRITTEN_BACK = -1.0  # support of cells that hold a prediction; that of others is not negative


def make_completion_net(cfg: CompletionConfig | None, given: CompletionNet | None) -> CompletionNet | None:
    """Return the network that a config asks for: the given one, or one of its file, frozen; else None.

    Raises ValueError if a network is given although the config asks for none.
    """
    if cfg is None:
        rule, hint = "must be None unless the config asks for completion", "give the config a CompletionConfig"
        require(given is None, "completion_net", rule, "a network", hint)
        return None
    from torchelev.completion.net import CompletionNet  # a map without completion needs no network

    if given is None:
        return CompletionNet.from_pretrained(cfg.weights).requires_grad_(False)
    is_net, hint = isinstance(given, CompletionNet), "give one that CompletionNet.from_pretrained returned"
    require(is_net, "completion_net", "must be a CompletionNet", type(given).__name__, hint, TypeError)
    return given


def complete_map(state: MapState, grid: GridConfig, weights: Weights) -> Completion:
    """Predict the ground at every cell, in float32 or float64. The standard deviation lacks that of the poses."""
    from torchelev.completion.complete import CompletionInput, complete  # as above

    state = forget_completed(state)  # or one prediction would make the next one surer
    dtype = torch.promote_types(state.elevation.dtype, torch.float32)
    elevation, variance, upper_bound, time = (
        layer.to(dtype) for layer in (state.elevation, state.variance, state.upper_bound, state.time)
    )
    layers = CompletionInput(elevation, state.validity, variance, upper_bound, state.bounded, time)
    return complete(type(weights)(*(weight.to(dtype) for weight in weights)), layers, grid.resolution)


def completed_layers(state: MapState, grid: GridConfig, weights: Weights) -> dict[str, Layer]:
    """Return the layers COMPLETED of a state, known everywhere in environments that know the elevation of a cell."""
    mean, std = complete_map(state, grid, weights)
    std = (std.square() + pose_variance(state).to(std.dtype)).sqrt()
    known = _knows_any(state)[:, None, None].expand_as(state.validity)
    return {name: (value.to(state.elevation.dtype), known) for name, value in zip(COMPLETED, (mean, std), strict=True)}


def _knows_any(state: MapState) -> Bool[Tensor, "B"]:
    """Return which environments know an elevation that is no prediction."""
    return (state.validity & (state.support >= 0)).any(2).any(1)


# Predictions as cells of the map ----------------------------------------------------------------------------------


def forget_completed(state: MapState) -> MapState:
    """Make the cells that `write_back` filled unknown again; their upper bounds were kept."""
    written = state.validity & (state.support < 0)
    return state._replace(
        elevation=torch.where(written, 0.0, state.elevation),
        variance=torch.where(written, BLANK["variance"], state.variance),
        validity=state.validity & ~written,
        support=torch.where(written, 0.0, state.support),
    )


def write_back(before: MapState, state: MapState, grid: GridConfig, weights: Weights, max_std: float) -> MapState:
    """Give unknown cells the predicted height, or the prediction that they held before if that is surer.

    Ratings and normals stay those of the other cells alone, as predictions are forgotten before the next update: what
    is measured is then the same as in a map without them, and so is the first measurement of such a cell.

    Args:
        before: the map before the update, with earlier predictions.
        state: the map after it, without predictions.
        grid: the maps' grid.
        weights: of the network.
        max_std: [m] predictions that are less sure are left out.
    """
    mean, std = (value.to(state.elevation.dtype) for value in complete_map(state, grid, weights))
    variance = torch.where(_knows_any(state)[:, None, None], std.square(), torch.inf)
    height, earlier, held = _move_predictions(before, state)
    holds = held & ~(state.bounded & (height > state.upper_bound))  # rays have passed below the others
    is_surer = holds & (earlier < variance)
    mean, variance = torch.where(is_surer, height, mean), torch.where(is_surer, earlier, variance)
    found = ~state.validity & (variance < max_std**2)
    return state._replace(
        elevation=torch.where(found, mean, state.elevation),
        variance=torch.where(found, variance, state.variance),
        validity=state.validity | found,
        time=torch.where(found, 0.0, state.time),
        support=torch.where(found, WRITTEN_BACK, state.support),
    )


def _move_predictions(before: MapState, state: MapState) -> tuple[Tensor, Tensor, Bool[Tensor, "B H W"]]:
    """Return heights [m] and variances [m^2] of earlier predictions in the present window, and where there are some."""
    largest = max(state.validity.shape[1:])
    shift = (state.corner - before.corner).clamp(-largest, largest)
    held = before.validity & (before.support < 0)
    moved = move_layers({"height": before.elevation, "variance": before.variance, "held": held}, shift, BLANK)
    drift = state.statistics.drift_correction[:, None, None]
    return moved["height"] + drift, moved["variance"], moved["held"]
