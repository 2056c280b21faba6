"""Which backend runs an update."""

from __future__ import annotations

import contextlib
from typing import NamedTuple

import torch
from torch import Tensor

from torchelev.kernels.cpu_build import find_compiler, is_switched_off
from torchelev.kernels.cpu_update import is_built
from torchelev.kernels.cuda_build import can_launch
from torchelev.ops.transforms import is_transforming

_SWITCHED_OFF = "TORCHELEV_NATIVE=0 forbids compiled code"


class Backend(NamedTuple):
    """What runs an update: "CPU" is C++ and "CUDA" are kernels, both in place; "TORCH" are tensors."""

    name: str  #: "CPU", "CUDA" or "TORCH"
    reason: str  #: why it is not a faster one; empty where it is the fastest

    def __str__(self) -> str:
        """Return name and reason in a sentence."""
        what = {"CPU": "C++ on a CPU", "CUDA": "CUDA kernels", "TORCH": "tensors"}[self.name]
        return f"{self.name}: updates run by {what}" + (f", as {self.reason}" if self.reason else "")


def choose(layer: Tensor, key: int, only_by_tensors: str = "") -> Backend:
    """Return the backend for maps with such a layer (B, H, W): asked once per update.

    `key` is that of the compiled stages for a CPU; `only_by_tensors` says why there are none for the config.
    """
    reason = only_by_tensors or _why_tensors(layer, key)
    return Backend("TORCH", reason) if reason else Backend("CUDA" if layer.is_cuda else "CPU", "")


def _why_tensors(layer: Tensor, key: int) -> str:
    """Return why compiled code cannot update such maps; empty where it can."""
    if layer.dtype != torch.float32:
        return f"the maps are {str(layer.dtype).removeprefix('torch.')}, and compiled code computes float32"
    if type(layer) not in (Tensor, torch.nn.Parameter) or is_transforming():
        return "a transform wraps the tensors"
    if not layer.is_cpu and not layer.is_cuda:
        return f"there is no compiled code for {layer.device.type}"
    if not layer.is_contiguous():
        return "the layers are not contiguous; load the map by load_state"
    if layer.is_cuda:
        return _why_no_kernels(layer)
    return "" if is_built(key) else _why_not_built()


def _why_no_kernels(layer: Tensor) -> str:
    if torch.are_deterministic_algorithms_enabled():
        return "results must repeat, and kernels add up in any order"
    if layer.numel() >= 2**31:
        return "kernels count cells in 32 bits"
    if is_switched_off():
        return _SWITCHED_OFF
    return "" if can_launch(layer.get_device()) else "CUDA kernels do not run on this GPU, see the warning"


def _why_not_built() -> str:
    if is_switched_off():
        return _SWITCHED_OFF
    with contextlib.suppress(FileNotFoundError):  # CXX names none, as a warning says
        if find_compiler() is None:
            return "no C++ compiler was found"
    return "the C++ could not be built, see the warning"
