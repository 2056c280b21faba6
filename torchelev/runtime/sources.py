"""The sources of the C library."""

from __future__ import annotations

from torchelev.kernels.registry import PACKAGE

_OWN = (
    "torchelev",
    "body",
    "config",
    "image",
    "layout",
    "map",
    "poses",
    "scan",
    "settings",
    "state_file",
    "diagnosis/causes",
    "diagnosis/evidence",
)

#: seen from the package; the first one names the library
SOURCES = (
    *(f"runtime/source/{name}.cpp" for name in _OWN),
    *sorted(str(path.relative_to(PACKAGE)) for path in (PACKAGE / "stages").glob("*/cpu.cpp")),
)
