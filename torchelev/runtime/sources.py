"""The sources of the C library."""

from __future__ import annotations

from torchelev.kernels.registry import PACKAGE

_NAMED_FOR = "runtime/source/torchelev.cpp"  # the library is called as its first source
_FOUND = (
    path
    for pattern in ("runtime/source/**/*.cpp", "stages/*/cpu.cpp", "levels/kernel/*.cpp")
    for path in PACKAGE.glob(pattern)
)

#: seen from the package; the first one names the library
SOURCES = (_NAMED_FOR, *sorted({str(path.relative_to(PACKAGE)) for path in _FOUND} - {_NAMED_FOR}))
