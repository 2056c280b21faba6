"""The completion in C++ (`torchelev/completion/kernel`): the same as `predict` and `refine`, many times faster."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from torchelev.completion import context, parameters, predict, refine, surroundings
from torchelev.completion.parameters import Weights
from torchelev.kernels.cpu_build import call, load

_LARGEST = 2**15 - 2  # cells along a side, as steps are counted in 16 bits
_FLOATS = {
    "UNKNOWN": surroundings.UNKNOWN,
    "REACH_0": surroundings.REACHES[0],
    "REACH_1": surroundings.REACHES[1],
    "NOWHERE": predict.NOWHERE,
    "NEAR_STEP": predict.STEP,
    "FARTHEST": predict.FARTHEST,
    "STEEPEST": predict.STEEPEST,
    "SMALL_STEP": parameters.SMALL_STEP,
    "MARGIN": predict.MARGIN,
    "NO_SPREAD": predict.NO_SPREAD,
    "FADE": predict.FADE,
    "NO_VOTE": predict.NO_VOTE,
    "LARGEST_LOG": predict.LARGEST_LOG,
    "USUAL": parameters.USUAL,
    "SQUASH": parameters.SQUASH,
    "MIN_STD": refine.MIN_STD,
    "LONG_AGO": refine.LONG_AGO,
}
_DOUBLES = {"RADIUS_0": context.RADII[0], "RADIUS_1": context.RADII[1], "SMALLEST_STD": context.SMALLEST_STD}
_CONSTANTS = {name: f"{value!r}f" for name, value in _FLOATS.items()} | {k: repr(v) for k, v in _DOUBLES.items()}


def library_of(weights: Weights) -> tuple[str, dict[str, str]]:
    """Return source and constants of the library for a network of such sizes."""
    sizes = {"VIEWS": weights.view, "CELLS": weights.cell, "MEASURED": weights.measured}
    return "completion/kernel/completion.cpp", _CONSTANTS | {name: str(len(weight)) for name, weight in sizes.items()}


def complete(weights: Weights, layers: Sequence[Tensor], resolution: float) -> tuple[Tensor, Tensor] | None:
    """Return mean and standard deviation [m] of each cell, (B, H, W); None where C++ cannot compute them.

    Args:
        weights: parameters.
        layers: of `CompletionInput`, on a CPU.
        resolution: [m].
    """
    elevation = layers[0]
    numbers = [*weights, *(layer for layer in layers if layer.dtype != torch.bool)]
    is_float = all(value.dtype == torch.float32 and value.device.type == "cpu" for value in numbers)
    is_plain = is_float and all(layer.shape == elevation.shape for layer in layers)
    if not is_plain or max(elevation.shape[1:]) > _LARGEST:
        return None
    library = load(*library_of(weights))
    if library is None:
        return None
    flat = torch.cat([weight.detach().flatten() for weight in weights])
    mean, std = (torch.empty_like(elevation, memory_format=torch.contiguous_format) for _ in range(2))
    tensors = [flat, *(layer.contiguous() for layer in layers), mean, std]
    pointers = [ctypes.c_void_p(tensor.data_ptr()) for tensor in tensors]
    call(library.complete, *pointers, *elevation.shape, ctypes.c_double(resolution), torch.get_num_threads())
    return mean, std
