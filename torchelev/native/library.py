"""Libraries of `torchelev/native`; see `torchelev.kernels.cpu_build`."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping

from torchelev.kernels import cpu_build
from torchelev.kernels.cpu_build import (  # noqa: F401
    cache_folder,
    call,
    describe_processor,
    find_compiler,
    is_switched_off,
)


def load(source: str, defines: Mapping[str, str]) -> ctypes.CDLL | None:
    """Return a library of a source in this folder."""
    return cpu_build.load(f"native/{source}", defines)
