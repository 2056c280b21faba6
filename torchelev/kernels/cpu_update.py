"""A whole update in one call of C++, for float32 maps on a CPU."""

from __future__ import annotations

import ctypes
import functools
import threading
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchelev.kernels.cpu_build import call, is_switched_off, load
from torchelev.kernels.registry import Kernel, header, settings_of
from torchelev.kernels.structs import SIZES
from torchelev.ops.library import LIBRARY

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Float64


class Inputs(NamedTuple):
    """The inputs of an update as C++ takes them: contiguous, float32, poses float64."""

    points: Float[Tensor, "B S N 3"]  #: [m] sensor frame
    T_map_sensor: Float64[Tensor, "B S 4 4"]  #: sensor-frame points into the map frame
    T_map_base: Float64[Tensor, "B 4 4"] | None  #: pose of the robot
    dt: Float[Tensor, "B"]  #: [s]
    variance: Float[Tensor, "B S N"] | None  #: [m^2]
    T_base_links: Float64[Tensor, "B K 4 4"] | None  #: poses of the links of the robot's body
    own: Bool[Tensor, "B S N"] | None  #: points on the robot's links
    pose_covariance: Float[Tensor, "B S 6 6"] | None  #: of each sensor's pose
    moving: Bool[Tensor, "B"] | None  #: environments whose height may drift
    aside: Bool[Tensor, "B S N"] | None  #: points of other surfaces than the ground


class Sizes(ctypes.Structure):
    """The sizes that shapes are made of, as C has them."""

    _fields_ = tuple((name, ctypes.c_int64) for name in SIZES)


class CpuUpdate:
    """The compiled stages of one config, which are built when they first run.

    Args:
        kernels: of all stages.
        tensors: structs of tensors: name, NamedTuple, nested structs.
        order: names of the stages, in their order.
        cfg: an ElevationMapConfig.
        default: the default config, from which the settings' types are.
    """

    def __init__(self, kernels: Sequence[Kernel], tensors: Sequence[Any], order: Sequence[str], cfg: Any, default: Any):
        self._kernels, self._tensors, self._order = kernels, tensors, tuple(order)
        self._cfg, self._default = cfg, default
        self._functions: dict[tuple[str, ...], Any] = {}  # addresses, by stages

    @functools.cached_property
    def library(self) -> ctypes.CDLL | None:
        """The library of all stages; None if it cannot be built."""
        return load(*self.parts)

    @property
    def parts(self) -> tuple[tuple[str, ...], dict[str, str], dict[str, str]]:
        """Sources, constants and headers of the library."""
        structs = header(self._kernels, self._default, [*self._tensors, ("Inputs", Inputs, {})])
        sources = ("kernels/update.cpp", *dict.fromkeys(kernel.cpu_source for kernel in self._kernels))
        return sources, {}, {"generated.h": structs}

    @functools.cached_property
    def _settings(self) -> ctypes.Structure:
        return settings_of(self._kernels, self._cfg, self._default)

    def run(
        self,
        state: Sequence[Tensor],
        inputs: Sequence[Tensor | None],
        stages: Sequence[str] | None = None,
        levels: Sequence[Tensor] = (),
    ) -> None:
        """Run stages, by name, or all, on a state's tensors (B, ...) and those of its levels, if any, in place.

        Raises:
            MemoryError: without enough memory. Some maps then lack a part of this update.
        """
        assert self.library is not None
        sizes = sizes_of(state, inputs, levels)
        functions = self._addresses(self._order if stages is None else tuple(stages))
        arguments = addresses(state), addresses(inputs), addresses(levels) if levels else None, self._settings, sizes
        references = (None if value is None else ctypes.byref(value) for value in arguments)
        # A backward pass through what the maps held shall say so.
        torch.autograd.graph.increment_version([*state, *levels])
        call(self.library.update_maps, *references, functions, ctypes.c_int64(len(functions)), torch.get_num_threads())

    def _addresses(self, stages: tuple[str, ...]) -> Any:
        """Return the addresses of the stages' functions."""
        if stages not in self._functions:
            pointers = (ctypes.cast(getattr(self.library, f"run_{name}"), ctypes.c_void_p) for name in stages)
            self._functions[stages] = (ctypes.c_void_p * len(stages))(*(pointer.value for pointer in pointers))
        return self._functions[stages]


_UPDATES: list[CpuUpdate] = []  # by key
_LOCK = threading.Lock()


def register(update: CpuUpdate) -> int:
    """Return a key of compiled stages, by which `run` finds them."""
    with _LOCK:
        _UPDATES.append(update)
        return len(_UPDATES) - 1


def compiled_stages(key: int) -> CpuUpdate:
    """Return the compiled stages of a key."""
    return _UPDATES[key]


def is_built(key: int) -> bool:
    """Build the stages of a key, unless they are built; return whether they are there."""
    return not is_switched_off() and _UPDATES[key].library is not None


# As `torch.compiler.assume_constant_result` does, which would load the compiler: code that is compiled asks only once.
is_built._dynamo_marked_constant = True  # type: ignore[attr-defined]


def run(key: int, state: Sequence[Tensor], inputs: Inputs, levels: Sequence[Tensor] = ()) -> None:
    """Run all stages in place; inside a `torch.compile` of the user's own as one operator of its graph."""
    if torch.compiler.is_compiling():
        torch.ops.torchelev.update_maps(list(state), list(inputs), list(levels), key)
    else:
        _UPDATES[key].run(state, inputs, levels=levels)


LIBRARY.define("update_maps(Tensor(a!)[] state, Tensor?[] inputs, Tensor(b!)[] levels, int key) -> ()")
LIBRARY.impl("update_maps", lambda state, inputs, levels, key: _UPDATES[key].run(state, inputs, levels=levels), "CPU")
torch.library.register_fake("torchelev::update_maps", lambda state, inputs, levels, key: None, lib=LIBRARY)

_LINKS = Inputs._fields.index("T_base_links")


def sizes_of(state: Sequence[Tensor], inputs: Sequence[Tensor | None], levels: Sequence[Tensor] = ()) -> Sizes:
    """Return the sizes of a state's tensors, of their inputs and of their levels."""
    points, links = inputs[0], inputs[_LINKS]
    assert points is not None
    S, N = points.shape[1:3]
    K, L = 0 if links is None else links.shape[1], levels[_LOWER].shape[1] if levels else 0
    return Sizes(*state[_ELEVATION].shape, S, N, K, S * N, S if S > 1 else 0, L)


_ELEVATION = 4  # place of the elevation among a state's tensors
_LOWER = 1  # place of a layer (B, L, H, W) among the tensors of levels


def addresses(tensors: Sequence[Tensor | None]) -> ctypes.Array[ctypes.c_void_p]:
    """Return the addresses of tensors, which is also a C struct of pointers to them; null for None."""
    return (ctypes.c_void_p * len(tensors))(*(None if tensor is None else tensor.data_ptr() for tensor in tensors))


def as_inputs(values: Mapping[str, Tensor | None]) -> Inputs:
    """Return inputs, by name, in the dtypes and layout that C++ takes."""
    chosen = ((values[name], kind) for name, kind in _KINDS.items())
    return Inputs(*(None if value is None else value.to(kind).contiguous() for value, kind in chosen))  # type: ignore


_KINDS = {
    name: torch.bool
    if name in ("own", "moving", "aside")
    else torch.float64
    if name.startswith("T_")
    else torch.float32
    for name in Inputs._fields
}
