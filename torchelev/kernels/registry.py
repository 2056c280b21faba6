"""What a stage declares of its compiled code, and the headers that follow from all declarations."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchelev.kernels.structs import SIZES, Settings, c_settings, settings_struct, sizes_struct, tensor_struct

PACKAGE = Path(__file__).parents[1]  # includes begin here, such as "stages/age/equation.h"


@dataclass(frozen=True)
class Launch:
    """A kernel of a stage's cuda.cu, which takes an `Update` of kernels/cuda/update.h."""

    kernel: str  #: name of the function
    blocks: Callable[[Any], int]  #: returns the number of blocks, by all sizes
    threads: int = 256  #: of a block
    #: returns the memory [bytes] that a block's threads share, by the sizes and the settings of all kernels
    memory: Callable[[Any, Any], int] = lambda sizes, settings: 0


@dataclass(frozen=True, kw_only=True)
class Kernel:
    """The compiled code of one folder: `run_<stage>(Update&)` of each stage in cpu.cpp, and kernels in cuda.cu."""

    name: str  #: of the settings in C
    folder: str  #: seen from the package
    settings: Callable[[Any], Settings]  #: returns what the equations need of an ElevationMapConfig, by name
    #: launches of each stage of this kernel, by the stage's name
    cuda: Mapping[str, Sequence[Launch]] = field(default_factory=dict)
    #: arrays that the launches share, with those of other stages: name to C type and sizes, as "float B M"
    scratch: Mapping[str, str] = field(default_factory=dict)
    #: returns the arrays of `scratch` that no launch uses, by the sizes
    unused: Callable[[Any], Sequence[str]] = lambda sizes: ()
    #: returns sizes that launches and scratch take besides those of the inputs, by name, of an ElevationMapConfig
    sizes: Callable[[Any], Mapping[str, int]] = lambda cfg: {}
    #: stages whose launches run for each sensor, one after the other: the sensor of `Update`
    per_sensor: tuple[str, ...] = ()

    @property
    def cpu_source(self) -> str:
        """The C++ source, seen from the package."""
        return f"{self.folder}/cpu.cpp"

    @property
    def cuda_source(self) -> str:
        """The CUDA source, seen from the package."""
        return f"{self.folder}/cuda.cu"

    @property
    def struct(self) -> str:
        """Name of the settings' struct in C."""
        return f"{self.name.title().replace('_', '')}Settings"


def header(
    kernels: Sequence[Kernel],
    cfg: Any,
    tensors: Sequence[tuple[str, Any, dict[str, str]]],
    sizes: Iterable[str] = SIZES,
) -> str:
    """Return the C header of all structs: sizes, tensors (name, NamedTuple, nested structs), settings of all kernels.

    The settings' types are those of any config.
    """
    structs = [sizes_struct(sizes), *(tensor_struct(*arguments) for arguments in tensors)]
    structs += [settings_struct(kernel.struct, kernel.settings(cfg)) for kernel in kernels]
    whole = "\n".join(f"    {kernel.struct} {kernel.name};" for kernel in kernels)
    return "\n".join(["#pragma once\n#include <cstdint>\n", *structs, f"struct Settings {{\n{whole}\n}};\n"])


def settings_of(kernels: Sequence[Kernel], cfg: Any, default: Any) -> ctypes.Structure:
    """Return the settings of all kernels by a config as C has them, `Settings` of `header`; types are the default's."""
    own, like = ({kernel.name: kernel.settings(c) for kernel in kernels} for c in (cfg, default))
    return c_settings(own, like)


def once(sizes: Any) -> int:
    """Return blocks of 256 threads, one for each map."""
    return int(-(-sizes.B // 256))


def per_map(sizes: Any) -> int:
    """Return a block for each map."""
    return int(sizes.B)


def per_point(sizes: Any) -> int:
    """Return blocks of 256 threads, one for each point; a map's points begin with a block."""
    return int(sizes.B * -(-sizes.M // 256))


def per_cell(sizes: Any) -> int:
    """Return blocks of 256 threads, one for each cell; a map's cells begin with a block."""
    return int(sizes.B * -(-(sizes.H * sizes.W) // 256))


def per_row(sizes: Any) -> int:
    """Return blocks of 256 threads, a warp for each row of cells; a map's rows begin with a block."""
    return int(sizes.B * -(-(32 * sizes.H) // 256))


def block_sums(sizes: Any, settings: Any) -> int:
    """Return the memory [bytes] that sums over a block's threads take: a number of eight bytes for each warp."""
    return 8 * 32
