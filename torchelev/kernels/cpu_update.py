"""A whole update in one call of C++, for float32 maps on a CPU."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchelev.kernels.cpu_build import call, load
from torchelev.kernels.registry import Kernel, header
from torchelev.kernels.structs import c_settings

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Float64


class Inputs(NamedTuple):
    """The inputs of an update as C++ takes them: contiguous, float32, poses float64."""

    points: Float[Tensor, "B S N 3"]  #: [m] sensor frame
    T_map_sensor: Float64[Tensor, "B S 4 4"]
    T_map_base: Float64[Tensor, "B 4 4"] | None
    dt: Float[Tensor, "B"]  #: [s]
    variance: Float[Tensor, "B S N"] | None  #: [m^2]
    T_base_links: Float64[Tensor, "B K 4 4"] | None
    own: Bool[Tensor, "B S N"] | None  #: points on the robot's links
    pose_covariance: Float[Tensor, "B S 6 6"] | None


class _Sizes(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_int64) for name in "BHWSNK")


class CpuUpdate:
    """The compiled stages of one config.

    Args:
        kernels: of all stages.
        tensors: structs of tensors: name, NamedTuple, nested structs.
        cfg: an ElevationMapConfig.
        default: the default config, from which the settings' types are.
    """

    def __init__(
        self, kernels: Sequence[Kernel], tensors: Sequence[tuple[str, Any, dict[str, str]]], cfg: Any, default: Any
    ) -> None:
        structs = header(kernels, default, [*tensors, ("Inputs", Inputs, {})])
        sources = ("kernels/update.cpp", *dict.fromkeys(kernel.cpu_source for kernel in kernels))
        self.library = load(sources, {}, {"generated.h": structs})
        self._settings = c_settings({kernel.name: kernel.settings(cfg) for kernel in kernels})

    def __call__(self, stages: Sequence[str], state: Sequence[Tensor], inputs: Inputs) -> None:
        """Run stages, by name, on a state's tensors (B, ...), in place.

        Raises:
            MemoryError: without enough memory. The maps are sound, but some may lack this update or a part of it.
        """
        assert self.library is not None
        B, H, W = state[_ELEVATION].shape
        S, N = inputs.points.shape[1:3]
        sizes = _Sizes(B, H, W, S, N, 0 if inputs.T_base_links is None else inputs.T_base_links.shape[1])
        functions, number = self._functions(tuple(stages)), len(stages)
        arguments = addresses(state), addresses(inputs), self._settings, sizes
        references = (ctypes.byref(value) for value in arguments)
        call(self.library.update_maps, *references, functions, ctypes.c_int64(number), torch.get_num_threads())

    @functools.lru_cache(maxsize=8)  # noqa: B019  # of a few orders, for as long as the config is used
    def _functions(self, stages: tuple[str, ...]) -> Any:
        """Return the addresses of the stages' functions."""
        pointers = (ctypes.cast(getattr(self.library, f"run_{name}"), ctypes.c_void_p) for name in stages)
        return (ctypes.c_void_p * len(stages))(*(pointer.value for pointer in pointers))


_ELEVATION = 4  # place of the elevation among a state's tensors


def addresses(tensors: Sequence[Tensor | None]) -> ctypes.Array[ctypes.c_void_p]:
    """Return the addresses of tensors, which is also a C struct of pointers to them; null for None."""
    return (ctypes.c_void_p * len(tensors))(*(None if tensor is None else tensor.data_ptr() for tensor in tensors))


def as_inputs(values: Mapping[str, Tensor | None]) -> Inputs:
    """Return inputs, by name, in the dtypes and layout that C++ takes."""

    def convert(name: str, value: Tensor | None) -> Tensor | None:
        if value is None:
            return None
        kind = torch.bool if name == "own" else torch.float64 if name.startswith("T_") else torch.float32
        return value.to(kind).contiguous()

    return Inputs(**{name: convert(name, values[name]) for name in Inputs._fields})  # type: ignore[arg-type]
