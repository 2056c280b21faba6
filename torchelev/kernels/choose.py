"""Which backend runs an update."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchelev.kernels.cpu_build import find_compiler, is_native, is_switched_off
from torchelev.ops.transforms import is_transforming


class Backend(NamedTuple):
    """What runs an update: "CPU" is C++ and "CUDA" are kernels, both in place; "TORCH" are tensors."""

    name: str
    reason: str  #: why it is not a faster one; empty where it is the fastest

    def __str__(self) -> str:
        """Return name and reason in a sentence."""
        what = {"CPU": "C++ on a CPU", "CUDA": "CUDA kernels", "TORCH": "tensors"}[self.name]
        return f"{self.name}: updates run by {what}" + (f", as {self.reason}" if self.reason else "")


def choose(layer: Tensor) -> Backend:
    """Return the backend for maps with such a layer (B, H, W): asked once per update."""
    reason = _why_tensors(layer)
    return Backend("TORCH", reason) if reason else Backend("CPU", "")


def _why_tensors(layer: Tensor) -> str:
    """Return why compiled code cannot update such maps; empty where it can."""
    if layer.dtype != torch.float32:
        return f"the maps are {str(layer.dtype).removeprefix('torch.')}, and compiled code computes float32"
    if type(layer) not in (Tensor, torch.nn.Parameter) or is_transforming():
        return "a transform wraps the tensors"
    if not layer.is_cpu:
        return f"there are no kernels for {layer.device.type} yet"
    if not layer.is_contiguous():
        return "the layers are not contiguous; load the map by load_state"
    return "" if is_native() else _why_not_built()


def _why_not_built() -> str:
    if is_switched_off():
        return "TORCHELEV_NATIVE=0 forbids compiled code"
    return "no C++ compiler was found" if find_compiler() is None else "the C++ could not be built, see the warning"
