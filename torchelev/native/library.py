"""The C++ libraries: built once for each machine, kept in the user's cache."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path

_SOURCES = Path(__file__).parent
_FLAGS = "-std=c++17 -O3 -march=native -fno-math-errno -fno-trapping-math -fPIC -shared -pthread -Wno-psabi".split()
_OFF = ("0", "off", "false", "no")


def load(source: str, defines: Mapping[str, str], *flags: str) -> ctypes.CDLL | None:
    """Return a library, which is built if it is not in the cache.

    The cache is the folder in the environment variable TORCHELEV_CACHE, else `torchelev` in the user's cache folder.

    Args:
        source: file in this folder.
        defines: values of the constants that the source does not define.
        flags: further ones of the compiler.

    Returns:
        The library; None without a compiler, or with TORCHELEV_NATIVE=0 in the environment. If the compiler fails, a
        warning says so.
    """
    if os.environ.get("TORCHELEV_NATIVE", "1").lower() in _OFF:
        return None
    return _load(source, tuple(sorted(defines.items())), flags)


@functools.cache
def _load(source: str, defines: tuple[tuple[str, str], ...], further: tuple[str, ...]) -> ctypes.CDLL | None:
    compiler = find_compiler()
    if compiler is None:
        return None
    flags = [*_FLAGS, *further, *(f"-D{name}={value}" for name, value in defines)]
    try:
        path = cache_folder() / f"{Path(source).stem}-{_key(compiler, flags)}.so"
        if not path.exists():
            _build(compiler, flags, _SOURCES / source, path)
        return ctypes.CDLL(str(path))
    except (OSError, subprocess.SubprocessError) as error:
        reason = getattr(error, "stderr", None) or error
        warnings.warn(
            f"{source} could not be built, and slower code does its work: {reason}. Set CXX to another compiler, "
            "TORCHELEV_CACHE to a folder that can be written, or TORCHELEV_NATIVE=0 to build nothing.",
            RuntimeWarning,
            stacklevel=2,
        )
        return None


def find_compiler() -> str | None:
    """Return the C++ compiler: that of the environment variable CXX, else the first that is found."""
    names = [os.environ["CXX"]] if os.environ.get("CXX") else ["c++", "g++", "clang++"]
    return next((path for path in map(shutil.which, names) if path), None)


def cache_folder() -> Path:
    """Return the folder of the built libraries."""
    chosen = os.environ.get("TORCHELEV_CACHE")
    return Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchelev"


def _build(compiler: str, flags: list[str], source: Path, path: Path) -> None:
    """Compile a file; the library appears whole or not at all, also if several processes build it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        built = Path(folder) / path.name
        command = [compiler, *flags, str(source), "-o", str(built)]
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=300)
        os.replace(built, path)


def _key(compiler: str, flags: list[str]) -> str:
    """Return a hash of all that the library depends on: sources, flags, compiler and processor."""
    version = subprocess.run([compiler, "--version"], check=True, capture_output=True, timeout=60).stdout
    parts = [version, " ".join(flags).encode(), _processor()]
    parts += [path.read_bytes() for path in sorted(_SOURCES.rglob("*")) if path.suffix in (".cpp", ".h")]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:16]


def _processor() -> bytes:
    """Describe the processor, as -march=native makes code for this one."""
    try:
        lines = Path("/proc/cpuinfo").read_bytes().splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}".encode()
    return b"\n".join(sorted({line for line in lines if line.startswith((b"model name", b"flags", b"Features"))}))
