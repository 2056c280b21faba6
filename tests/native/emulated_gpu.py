"""CUDA kernels on a CPU, thread after thread: each source is compiled as C++, with a GPU's names defined.

A warp has one thread here: `tests/test_gpu.py` tests what threads share.
"""

import ctypes
import functools
import subprocess
import tempfile
from pathlib import Path

from torchelev.native import kernels
from torchelev.native.library import find_compiler

GPU = """
#include <cstdint>
#define __global__
struct { int64_t x; } blockIdx, threadIdx, blockDim;
constexpr int warpSize = 1;
template <class T, class U> T atomicAdd(T* number, U value) {
    const T before = *number;
    *number += value;
    return before;
}
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


def launch(source, kernel, rows, number, *arguments):
    """Do what `kernels.launch` does, on tensors of the CPU."""
    emulated = library(source)
    values = [kernels._argument(value) for value in arguments]
    for block in range(rows * -(-number // kernels._BLOCK)):
        for thread in range(kernels._BLOCK):
            emulated.take_place(block, thread, kernels._BLOCK)
            getattr(emulated, kernel)(*values)
