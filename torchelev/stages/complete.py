"""The completed map: what a network predicts of the ground that no sensor saw (`torchelev.completion`)."""

from __future__ import annotations

import torch

from torchelev.completion.complete import Completion, CompletionInput, complete
from torchelev.completion.config import CompletionConfig
from torchelev.completion.net import CompletionNet
from torchelev.completion.parameters import Weights
from torchelev.errors import require
from torchelev.grid import GridConfig
from torchelev.layers import Layer, pose_variance
from torchelev.state import MapState

COMPLETED = ("completed", "completed_std")  # names of the layers


def make_completion_net(cfg: CompletionConfig | None, given: CompletionNet | None) -> CompletionNet | None:
    """Return the network that a config asks for: the given one, or one of its file, frozen; else None.

    Raises ValueError if a network is given although the config asks for none.
    """
    if cfg is None:
        rule, hint = "must be None unless the config asks for completion", "give the config a CompletionConfig"
        require(given is None, "completion_net", rule, "a network", hint)
        return None
    if given is None:
        return CompletionNet.from_pretrained(cfg.weights).requires_grad_(False)
    is_net, hint = isinstance(given, CompletionNet), "give one that CompletionNet.from_pretrained returned"
    require(is_net, "completion_net", "must be a CompletionNet", type(given).__name__, hint, TypeError)
    return given


def complete_map(state: MapState, grid: GridConfig, weights: Weights) -> Completion:
    """Predict the ground at every cell, in float32 or float64. The standard deviation lacks that of the poses."""
    dtype = torch.promote_types(state.elevation.dtype, torch.float32)
    elevation, variance, upper_bound, time = (
        layer.to(dtype) for layer in (state.elevation, state.variance, state.upper_bound, state.time)
    )
    layers = CompletionInput(elevation, state.validity, variance, upper_bound, state.bounded, time)
    return complete(Weights(*(weight.to(dtype) for weight in weights)), layers, grid.resolution)


def completed_layers(state: MapState, grid: GridConfig, weights: Weights) -> dict[str, Layer]:
    """Return the layers COMPLETED of a state, known everywhere in environments that know the elevation of a cell."""
    mean, std = complete_map(state, grid, weights)
    std = (std.square() + pose_variance(state).to(std.dtype)).sqrt()
    known = state.validity.any(2).any(1)[:, None, None].expand_as(state.validity)
    return {name: (value.to(state.elevation.dtype), known) for name, value in zip(COMPLETED, (mean, std), strict=True)}
