"""CUDA kernels: compiled when first used, for the GPU at hand, by NVRTC, which comes with torch."""

from __future__ import annotations

import ctypes
import functools
import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchelev.kernels.cpu_build import is_switched_off
from torchelev.kernels.registry import PACKAGE

_STANDARD = "algorithm", "cmath", "cstdint", "limits"  # headers that NVRTC lacks: standard.h is all of them
_UNASKED_MEMORY = 48 * 2**10  # [bytes] that a block may have unasked
_MEMORY_ATTRIBUTE = 8  # CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
LIMITS = "processors", "block_memory"  # of a GPU
_CAN_LAUNCH: dict[int, bool] = {}  # by device


class Source(NamedTuple):
    """A CUDA source."""

    path: str  #: of the file, seen from the package
    headers: tuple[tuple[str, str], ...] = ()  #: names and texts of headers besides those of the package


def can_launch(device: int) -> bool:
    """Return whether kernels run on a GPU, given its number; False with TORCHELEV_NATIVE=0 in the environment.

    If they do not, though torch's own do, a warning says so.
    """
    if is_switched_off() or not torch.cuda.is_available() or torch.version.cuda is None:
        return False
    if device not in _CAN_LAUNCH:
        with torch.cuda.device(device):
            if torch.cuda.is_current_stream_capturing():  # in which nothing can be tried
                return False
            _CAN_LAUNCH[device] = _try(device)
    return _CAN_LAUNCH[device]


# As `torch.compiler.assume_constant_result` does, which would load the compiler: code that is compiled asks only once.
can_launch._dynamo_marked_constant = True  # type: ignore[attr-defined]


def launch(source: Source, kernel: str, blocks: int, threads: int, memory: int, *arguments: Any) -> None:
    """Run a kernel on the current device and stream.

    Args:
        source: of the kernel.
        kernel: function in that source.
        blocks: number of blocks.
        threads: threads of a block.
        memory: how much memory the threads of a block share [bytes].
        arguments: tensors and None are passed as addresses, ints as int64, ctypes values as they are.

    Raises:
        RuntimeError: if the source does not compile, or the driver refuses.
    """
    if blocks == 0:
        return
    values = [_argument(value) for value in arguments]
    addresses = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
    _bind_context()
    stream = ctypes.c_void_p(torch.cuda.current_stream().cuda_stream)
    function = _function(source, kernel, torch.cuda.current_device())
    sizes = (blocks, 1, 1, threads, 1, 1, memory)
    _check(_driver().cuLaunchKernel(function, *sizes, stream, addresses, None), kernel)


def load(source: Source, kernel: str, device: int) -> None:
    """Compile and load a kernel: while a graph is captured, none can be loaded."""
    _function(source, kernel, device)


@functools.cache
def limits(device: torch.device) -> dict[str, int]:
    """Return a GPU's LIMITS, by name: how many blocks can run at once, and how much memory [bytes] each may have."""
    properties = torch.cuda.get_device_properties(device)
    return {"processors": properties.multi_processor_count, "block_memory": block_memory(device.index)}


def block_memory(device: int) -> int:
    """Return how much memory the threads of a block may share [bytes], as torch knows it."""
    properties = torch.cuda.get_device_properties(device)
    memory: int = getattr(properties, "shared_memory_per_block_optin", _UNASKED_MEMORY)
    return memory


def _argument(value: Any) -> Any:
    if value is None or isinstance(value, Tensor):
        return ctypes.c_void_p(None if value is None else value.data_ptr())
    return ctypes.c_int64(value) if isinstance(value, int) else value


def _try(device: int) -> bool:
    """Run a kernel on the current device."""
    try:
        trial = Source("kernels/cuda/trial.cu")
        load(trial, "double_it", device)
        one = torch.ones(1, device=device, dtype=torch.float32)
        launch(trial, "double_it", 1, 32, 0, one)
        if one.item() != 2:
            raise RuntimeError("a kernel computed something else")
    except (AttributeError, OSError, RuntimeError) as error:  # AttributeError: a library lacks a function
        warnings.warn(
            f"CUDA kernels do not work here, and slower code does their work: {error}. TORCHELEV_NATIVE=0 builds none.",
            RuntimeWarning,
            stacklevel=3,
        )
        return False
    return True


def _bind_context() -> None:
    """Give a thread that has not used the GPU yet its context."""
    context = ctypes.c_void_p()
    _check(_driver().cuCtxGetCurrent(ctypes.byref(context)), "cuCtxGetCurrent")
    if not context.value:
        torch.zeros(1, device="cuda")


@functools.cache
def _driver() -> ctypes.CDLL:
    return ctypes.CDLL("nvcuda.dll" if os.name == "nt" else "libcuda.so.1")


def _check(result: int, what: str) -> None:
    if result != 0:
        text = ctypes.c_char_p()
        _driver().cuGetErrorString(result, ctypes.byref(text))
        raise RuntimeError(f"{what}: {(text.value or b'unknown error').decode()}")


@functools.cache
def _function(source: Source, kernel: str, device: int) -> ctypes.c_void_p:
    function = ctypes.c_void_p()
    module = _module(source, device)
    _check(_driver().cuModuleGetFunction(ctypes.byref(function), module, kernel.encode()), kernel)
    _check(_driver().cuFuncSetAttribute(function, _MEMORY_ATTRIBUTE, block_memory(device)), kernel)
    return function


@functools.cache
def _module(source: Source, device: int) -> ctypes.c_void_p:
    """Compile a source for a GPU, which must be the current one, and load it there."""
    module = ctypes.c_void_p()
    major, minor = torch.cuda.get_device_capability(device)
    code = compile_source(source, f"sm_{major}{minor}")
    _check(_driver().cuModuleLoadData(ctypes.byref(module), code), source.path)
    return module


def compile_source(source: Source, architecture: str) -> bytes:
    """Return a source's machine code for GPUs of an architecture; raise RuntimeError if there is none."""
    nvrtc, program = _nvrtc(), ctypes.c_void_p()
    headers = {p.relative_to(PACKAGE).as_posix(): p.read_bytes() for p in PACKAGE.rglob("*.h")}
    headers |= {name: text.encode() for name, text in source.headers}
    headers |= dict.fromkeys(_STANDARD, b'#include "kernels/cuda/standard.h"\n')
    texts, names = _strings(headers.values()), _strings(name.encode() for name in headers)
    text, name = (PACKAGE / source.path).read_bytes(), Path(source.path).name.encode()
    failed = nvrtc.nvrtcCreateProgram(ctypes.byref(program), text, name, len(headers), texts, names)
    options = [f"--gpu-architecture={architecture}", "--std=c++17", "--device-as-default-execution-space"]
    failed = failed or nvrtc.nvrtcCompileProgram(program, len(options), _strings(o.encode() for o in options))
    log = _read(nvrtc.nvrtcGetProgramLogSize, nvrtc.nvrtcGetProgramLog, program)
    code = _read(nvrtc.nvrtcGetCUBINSize, nvrtc.nvrtcGetCUBIN, program)
    nvrtc.nvrtcDestroyProgram(ctypes.byref(program))
    if failed:
        raise RuntimeError(f"NVRTC did not compile {source.path}: {log.decode(errors='replace').strip()}")
    return code


def _nvrtc() -> ctypes.CDLL:
    """Return NVRTC, which torch brings along, through the library of torch that is linked to it."""
    name = "caffe2_nvrtc.dll" if os.name == "nt" else "libcaffe2_nvrtc.so"
    return ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / name))


def _strings(values: Any) -> Any:
    values = list(values)
    return (ctypes.c_char_p * len(values))(*values)


def _read(get_size: Any, get: Any, program: ctypes.c_void_p) -> bytes:
    size = ctypes.c_size_t(0)
    get_size(program, ctypes.byref(size))
    data = ctypes.create_string_buffer(max(size.value, 1))
    get(program, data)
    return data.raw[: size.value]
