"""The sources of the C library."""

from __future__ import annotations

from torchelev.kernels.registry import PACKAGE

#: seen from the package; the first one names the library
SOURCES = (
    *(
        f"runtime/source/{name}.cpp"
        for name in ("torchelev", "config", "map", "poses", "scan", "settings", "state_file")
    ),
    *sorted(str(path.relative_to(PACKAGE)) for path in (PACKAGE / "stages").glob("*/cpu.cpp")),
)
