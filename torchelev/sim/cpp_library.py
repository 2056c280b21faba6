"""When the simulation runs in C++: for float32 on a CPU, where nothing is differentiated."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchelev.inputs.checks import readable
from torchelev.kernels.cpu_build import load


def find_library(library: tuple[str, dict[str, str]], *tensors: Tensor | None) -> ctypes.CDLL | None:
    """Return a library by its source and defines, None if it cannot take the tensors, of which None is left out.

    It takes float32 on a CPU without gradients. The tensors need not be contiguous.
    """
    given = [value for value in tensors if value is not None]
    is_plain = all(value.dtype == torch.float32 and readable(value) for value in given)
    has_gradient = torch.is_grad_enabled() and any(value.requires_grad for value in given)
    if not is_plain or has_gradient or forward_ad._current_level >= 0:
        return None
    return load(*library)


def address(value: Tensor | None) -> ctypes.c_void_p:
    """Return where the values of a contiguous tensor are stored, a null pointer for None."""
    return ctypes.c_void_p(None if value is None else value.data_ptr())
