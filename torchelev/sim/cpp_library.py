"""When the simulation runs in C++: for float32 on a CPU, where nothing is differentiated."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from torchelev.kernels.cpu_build import load
from torchelev.ops.transforms import can_compute_unseen


def find_library(library: tuple[str, dict[str, str]], *tensors: Tensor | None) -> ctypes.CDLL | None:
    """Return a library by its source and defines, None if it cannot take the tensors, of which None is left out.

    It takes float32 on a CPU without gradients. The tensors need not be contiguous.
    """
    given = [value for value in tensors if value is not None]
    fits = all(value.dtype == torch.float32 for value in given) and can_compute_unseen(given)
    return load(*library) if fits else None


def address(value: Tensor | None) -> ctypes.c_void_p:
    """Return where the values of a contiguous tensor are stored, a null pointer for None."""
    return ctypes.c_void_p(None if value is None else value.data_ptr())
