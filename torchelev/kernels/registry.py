"""What a stage declares of its compiled code, and the headers that follow from all declarations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchelev.kernels.structs import Settings, settings_struct, sizes_struct, tensor_struct

PACKAGE = Path(__file__).parents[1]  # includes begin here, such as "stages/age/equation.h"


@dataclass(frozen=True, kw_only=True)
class Kernel:
    """The compiled code of one stage: `run_<name>(Update&)` in its cpu.cpp, and kernels in its cuda.cu."""

    name: str  #: of the stage, and of its settings in C
    folder: str  #: of the stage, seen from the package
    settings: Callable[[Any], Settings]  #: returns what the equations need of an ElevationMapConfig, by name

    @property
    def cpu_source(self) -> str:
        """The C++ source, seen from the package."""
        return f"{self.folder}/cpu.cpp"

    @property
    def struct(self) -> str:
        """Name of the settings' struct in C."""
        return f"{self.name.title().replace('_', '')}Settings"


def header(kernels: Sequence[Kernel], cfg: Any, tensors: Sequence[tuple[str, Any, dict[str, str]]]) -> str:
    """Return the C header of all structs: sizes, tensors (name, NamedTuple, nested structs), settings of all kernels.

    The settings' types are those of any config.
    """
    structs = [sizes_struct(), *(tensor_struct(*arguments) for arguments in tensors)]
    structs += [settings_struct(kernel.struct, kernel.settings(cfg)) for kernel in kernels]
    whole = "\n".join(f"    {kernel.struct} {kernel.name};" for kernel in kernels)
    return "\n".join(["#pragma once\n#include <cstdint>\n", *structs, f"struct Settings {{\n{whole}\n}};\n"])
