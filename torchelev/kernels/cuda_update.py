"""A whole update by CUDA kernels, for float32 maps on a GPU, in place."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchelev.kernels import cuda_build
from torchelev.kernels.cpu_update import Inputs, Sizes, addresses, sizes_of
from torchelev.kernels.registry import Kernel, Launch, header, settings_of
from torchelev.kernels.structs import SIZES, scratch_struct

_DTYPES = {
    "float": torch.float32,
    "int32_t": torch.int32,
    "int64_t": torch.int64,
    "uint8_t": torch.uint8,
    "double": torch.float64,
}


class CudaUpdate:
    """The CUDA kernels of all stages of one config.

    Args:
        kernels: of all stages.
        tensors: structs of tensors: name, NamedTuple, nested structs.
        order: names of the stages, in their order.
        cfg: an ElevationMapConfig.
        default: the default config, from which the settings' types are.
        launch: runs a kernel; tests give one that runs it on a CPU.
        limits: returns sizes of a device, by name.
    """

    def __init__(
        self,
        kernels: Sequence[Kernel],
        tensors: Sequence[Any],
        order: Sequence[str],
        cfg: Any,
        default: Any,
        launch: Callable[..., None] = cuda_build.launch,
        limits: Callable[[torch.device], Mapping[str, int]] = cuda_build.limits,
    ) -> None:
        self._order, self._launch, self._limits = tuple(order), launch, limits
        self._kernels = tuple(kernels)
        self._arrays: dict[str, str] = {}
        for kernel in kernels:
            self._arrays |= kernel.scratch
        self._sizes = {name: size for kernel in kernels for name, size in kernel.sizes(cfg).items()}
        self._per_sensor = {stage for kernel in kernels for stage in kernel.per_sensor}
        structs = header(
            kernels, default, [*tensors, ("Inputs", Inputs, {})], (*SIZES, *cuda_build.LIMITS, *self._sizes)
        )
        whole = (("generated.h", f"{structs}\n{scratch_struct('Scratch', self._arrays)}"),)
        self._launches: dict[str, list[tuple[cuda_build.Source, Launch]]] = {}
        for kernel in kernels:
            source = cuda_build.Source(kernel.cuda_source, whole)
            self._launches |= {stage: [(source, one) for one in launches] for stage, launches in kernel.cuda.items()}
        self._settings = settings_of(kernels, cfg, default)
        self._loaded: set[int] = set()  # devices

    def run(
        self, state: Sequence[Tensor], inputs: Sequence[Tensor | None], stages: Sequence[str] | None = None
    ) -> dict[str, Tensor]:
        """Run stages, by name, or all, on a state's tensors (B, ...), in place; return what they passed on, by name."""
        sizes = _all_sizes(sizes_of(state, inputs), {**self._limits(state[0].device), **self._sizes})
        self._load(state[0].get_device())
        torch.autograd.graph.increment_version(state)
        scratch = self._allocate(sizes, state[0].device)
        update = self._update(sizes, state, inputs, list(scratch.values()))
        for stage in self._order if stages is None else stages:
            for update.sensor in range(sizes.S if stage in self._per_sensor else 1):
                for source, one in self._launches[stage]:
                    memory = one.memory(sizes, self._settings)
                    self._launch(source, one.kernel, one.blocks(sizes), one.threads, memory, update)
        return scratch

    def _load(self, device: int) -> None:
        """Load all kernels before one of them changes a map: what does not compile, or not in a capture, fails here."""
        if device < 0 or device in self._loaded:
            return
        for launches in self._launches.values():
            for source, one in launches:
                cuda_build.load(source, one.kernel, device)
        self._loaded.add(device)

    def _allocate(self, sizes: Any, device: torch.device) -> dict[str, Tensor]:
        unused = {name for kernel in self._kernels for name in kernel.unused(sizes)}

        def allocate(name: str, kind: str, *shape: str) -> Tensor:
            size = [0] if name in unused else [_size(s, sizes) for s in shape]
            return torch.empty(size, dtype=_DTYPES[kind], device=device)

        return {name: allocate(name, *text.split()) for name, text in self._arrays.items()}

    def _update(self, sizes: ctypes.Structure, *tensors: Sequence[Tensor | None]) -> ctypes.Structure:
        """Return `Update` of kernels/cuda/update.h."""
        pointers = [addresses(values) for values in tensors]
        update: ctypes.Structure = _structure(type(sizes), *map(len, pointers), type(self._settings))(
            sizes, *pointers, self._settings
        )
        return update


def _size(name: str, sizes: Any) -> int:
    return int(name) if name.isdigit() else int(getattr(sizes, name))


def _all_sizes(sizes: Sizes, own: Mapping[str, int]) -> ctypes.Structure:
    """Return the sizes of the inputs and those of the stages, by name."""
    all_sizes: ctypes.Structure = _sizes_type(tuple(own))(*(getattr(sizes, name) for name in SIZES), *own.values())
    return all_sizes


@functools.cache
def _sizes_type(own: tuple[str, ...]) -> Any:
    return type("Sizes", (ctypes.Structure,), {"_fields_": [(name, ctypes.c_int64) for name in (*SIZES, *own)]})


@functools.cache
def _structure(sizes: type, state: int, inputs: int, scratch: int, settings: type) -> Any:
    lists = {"state": state, "inputs": inputs, "scratch": scratch}
    fields = [("sizes", sizes), *((name, ctypes.c_void_p * size) for name, size in lists.items())]
    fields += [("settings", settings), ("sensor", ctypes.c_int64)]
    return type("Update", (ctypes.Structure,), {"_fields_": fields})
