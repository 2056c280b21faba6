"""What stages in C++ and CUDA share: when they may run, and a state's layers as they take and return them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchelev.ops import native, on_gpu
from torchelev.ops.storage import as_bytes, as_mask
from torchelev.state import MASKS, MapState


def has_one_pass(state: MapState) -> bool:
    """Tell whether a stage in C++ may run on a state: it computes float32 on a CPU, and has no gradient."""
    return native.computes(state.elevation) and not torch.is_grad_enabled()


def has_kernels(state: MapState) -> bool:
    """Tell whether a stage of CUDA kernels may run on a state: it is of float32 on a GPU, and has no gradient."""
    return on_gpu.computes(state.elevation) and not torch.is_grad_enabled()


def layers_of(state: MapState, names: Sequence[str]) -> list[Tensor]:
    """Return layers of the state (B, H, W), masks as bytes."""
    return [as_bytes(getattr(state, name)) if name in MASKS else getattr(state, name) for name in names]


def named(names: Sequence[str], layers: Sequence[Tensor]) -> dict[str, Tensor]:
    """Return layers by name, bytes as masks."""
    return {name: as_mask(layer) if name in MASKS else layer for name, layer in zip(names, layers, strict=True)}


def layers_to_change(state: MapState, names: Sequence[str], into: MapState | None) -> list[Tensor]:
    """Return layers that a stage may change in place, masks as bytes: those of `into`, or copies of those of `state`.

    `into` is the stored state, whose layers already hold what those of `state` do, masks as bytes.
    """
    if into is not None:
        return [getattr(into, name) for name in names]
    return [layer.clone(memory_format=torch.contiguous_format) for layer in layers_of(state, names)]


def new_numbers(like: Tensor) -> Tensor:
    """Return memory for a whole number of each environment (B,), given a tensor (B, ...)."""
    return like.new_empty(like.shape[0], dtype=torch.int64)


def put(layers: Sequence[Tensor], names: Sequence[str], state: MapState) -> None:
    """Write layers of a state into the given ones, masks as bytes."""
    for layer, name in zip(layers, names, strict=True):
        layer.copy_(getattr(state, name))
