"""CUDA kernels on a CPU, thread after thread: each source is compiled as C++, with a GPU's names defined."""

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
    folder = Path(tempfile.mkdtemp())
    (folder / "gpu.h").write_text(GPU)
    path = kernels._SOURCES / source
    includes = ["-include", str(folder / "gpu.h"), f"-I{path.parent}", f"-I{kernels._SOURCES / 'gpu'}"]
    flags = ["-std=c++17", "-O1", "-fPIC", "-shared", "-fsanitize=undefined", "-fno-sanitize-recover"]
    built = folder / "kernels.so"
    subprocess.run([*find_compiler(), *flags, *includes, "-x", "c++", str(path), "-o", str(built)], check=True)
    return ctypes.CDLL(str(built))


def launch(source, kernel, rows, number, *arguments):
    """Do what `kernels.launch` does, on tensors of the CPU."""
    emulated = library(source)
    values = [kernels._argument(value) for value in arguments]
    for block in range(rows * -(-number // kernels._THREADS)):
        for thread in range(kernels._THREADS):
            emulated.take_place(block, thread, kernels._THREADS)
            getattr(emulated, kernel)(*values)
