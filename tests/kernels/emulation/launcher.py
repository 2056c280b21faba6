"""Launch kernels on a CPU as on a GPU: `launcher = emulated(path, [folders of headers])`."""

import ctypes
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from tests.kernels.emulation.build import build
from torchelev.kernels.cpu_build import find_compiler

needs_emulation = pytest.mark.skipif(
    sys.platform != "linux" or find_compiler() is None, reason="needs Linux and a C++ compiler"
)
BLOCK, LARGE_BLOCK = 128, 512  # threads, as in torchelev/kernels/cuda_build.py


class Launcher:
    """The kernels of one CUDA source, on tensors of the CPU."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        self.is_backward = False  #: whether the last block and thread begin: what depends on the order shows
        self._launch = library.emulation_launch
        self._launch.restype = ctypes.c_char_p

    def __call__(self, kernel: str, grid, block, shared: int, *arguments) -> None:
        """Run a kernel.

        Args:
            kernel: function in the source.
            grid: number of blocks, or up to three numbers.
            block: threads of a block, likewise.
            shared: memory that the threads of a block share, besides that of a fixed size [bytes].
            arguments: tensors and None are passed as addresses, ints as int64, ctypes values as they are.

        Raises:
            AssertionError: if lanes wait for each other in vain or read what no lane brings, if a block takes more
                shared memory than it asks for, or if the arguments are not as many or as large as the kernel's.
        """
        values = [as_parameter(value) for value in arguments]
        self._check_sizes(kernel, values)
        addresses = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
        entry = ctypes.cast(getattr(self._library, f"emulated_{kernel}"), ctypes.c_void_p)
        sizes = _three(grid), _three(block), ctypes.c_size_t(shared)
        failure = self._launch(entry, addresses, *sizes, int(self.is_backward))
        assert failure is None, f"{kernel}: {failure.decode()}"

    def launch(self, kernel: str, rows: int, number: int, *arguments) -> None:
        """Do what `torchelev.kernels.cuda_build.launch` does."""
        self(kernel, rows * -(-number // BLOCK), BLOCK, 0, *arguments)

    def launch_blocks(self, kernel: str, blocks: int, memory: int, *arguments) -> None:
        """Run a kernel in so many large blocks, which share memory [bytes]."""
        self(kernel, blocks, LARGE_BLOCK, memory, *arguments)

    def _check_sizes(self, kernel: str, values: Sequence) -> None:
        sizes = getattr(self._library, f"sizes_{kernel}")
        sizes.restype = ctypes.POINTER(ctypes.c_int64)
        expected = []
        while size := sizes()[len(expected)]:
            expected.append(size)
        actual = [ctypes.sizeof(value) for value in values]
        assert actual == expected, f"{kernel}: arguments have {actual} bytes, its parameters {expected}"


def emulated(path: str | Path, include_dirs: Sequence[str | Path] = ()) -> Launcher:
    """Return the kernels of a CUDA source, which is compiled for the CPU at the first call.

    Args:
        path: the source; its folder is searched for headers.
        include_dirs: further folders of headers.

    Raises:
        RuntimeError: if the source does not compile.
    """
    return Launcher(build(Path(path), tuple(Path(folder) for folder in include_dirs)))


def as_parameter(value):
    """Return an argument as a kernel takes it."""
    if value is None or isinstance(value, torch.Tensor):
        return ctypes.c_void_p(None if value is None else value.data_ptr())
    return ctypes.c_int64(value) if isinstance(value, int) else value


def _three(sizes) -> ctypes.Array:
    numbers = (sizes,) if isinstance(sizes, int) else tuple(sizes)
    return (ctypes.c_uint * 3)(*numbers, *[1] * (3 - len(numbers)))
