"""CUDA kernels on a CPU, thread after thread: each source is compiled as C++, with a GPU's names defined.

A warp, and a block that shares memory, has one thread here: `tests/test_gpu.py` tests what threads share.
"""

import contextlib
import ctypes
import functools
import subprocess
import tempfile
from pathlib import Path
from unittest.mock import patch

import pytest

from torchelev.native import kernels
from torchelev.native.library import find_compiler

MEMORY, UNTOUCHED = 4 * 2**16, 0x5A  # [bytes] of a block; what fills them
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="needs a C++ compiler")
GPU = """
#include <cstdint>
#include <cstring>
#define __global__
#define __launch_bounds__(...)
#define __shared__
#define __syncthreads()
int32_t memory[1 << 16];
struct { int64_t x; } blockIdx, threadIdx, blockDim;
constexpr int warpSize = 1;
template <class T, class U> T atomicAdd(T* number, U value) {
    const T before = *number;
    *number += value;
    return before;
}
inline void atomicMin(int32_t* number, int32_t value) { *number = value < *number ? value : *number; }
template <class T, class U> T bits_of(U value) {
    T bits;
    std::memcpy(&bits, &value, sizeof bits);
    return bits;
}
inline int32_t __float_as_int(float value) { return bits_of<int32_t>(value); }
inline float __int_as_float(int32_t value) { return bits_of<float>(value); }
template <class T> T __shfl_xor_sync(unsigned, T value, int) { return value; }
extern "C" void take_place(int64_t block, int64_t thread, int64_t size) {
    blockIdx.x = block, threadIdx.x = thread, blockDim.x = size;
}
"""


@functools.cache
def library(source):
    path = kernels._SOURCES / source
    flags = ["-std=c++17", "-O1", "-fPIC", "-shared", "-fsanitize=undefined", "-fno-sanitize-recover"]
    with tempfile.TemporaryDirectory() as name:
        header, built = Path(name) / "gpu.h", Path(name) / "kernels.so"
        header.write_text(GPU)
        includes = ["-include", str(header), f"-I{path.parent}", f"-I{kernels._SOURCES / 'gpu'}"]
        subprocess.run([*find_compiler(), *flags, *includes, "-x", "c++", str(path), "-o", str(built)], check=True)
        return ctypes.CDLL(str(built))


def launch_blocks(source, kernel, blocks, memory, *arguments):
    """Do what `kernels.launch_blocks` does, on tensors of the CPU, with one thread for each block."""
    emulated = library(source)
    whole = (ctypes.c_uint8 * MEMORY).in_dll(emulated, "memory")
    beyond = (ctypes.c_uint8 * (MEMORY - memory)).from_buffer(whole, memory)
    ctypes.memset(beyond, UNTOUCHED, len(beyond))
    values = [kernels._argument(value) for value in arguments]
    for block in range(blocks):
        emulated.take_place(block, 0, 1)
        getattr(emulated, kernel)(*values)
    assert bytes(beyond).count(UNTOUCHED) == len(beyond), f"{kernel} takes more memory than it asks for"


def launch(source, kernel, rows, number, *arguments):
    """Do what `kernels.launch` does, on tensors of the CPU."""
    emulated = library(source)
    values = [kernels._argument(value) for value in arguments]
    for block in range(rows * -(-number // kernels._BLOCK)):
        for thread in range(kernels._BLOCK):
            emulated.take_place(block, thread, kernels._BLOCK)
            getattr(emulated, kernel)(*values)


@contextlib.contextmanager
def emulated_kernels(in_blocks):
    """Emulate kernels; `in_blocks`: those whose blocks share memory, where there is a choice."""
    with (
        patch.object(kernels, "work_on", lambda *_: True),
        patch.object(kernels, "launch", launch),
        patch.object(kernels, "launch_blocks", launch_blocks),
        patch.object(kernels, "suits_blocks", lambda *_: in_blocks),
    ):
        yield
