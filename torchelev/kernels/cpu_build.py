"""The C++ libraries: built once for each machine, kept in the user's cache."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from torchelev.errors import require
from torchelev.kernels.registry import PACKAGE

# Without contraction numbers are rounded as in torch, and alike on all processors.
_FLAGS = "-std=c++17 -O3 -ffp-contract=off -fno-math-errno -fno-trapping-math -fPIC -pthread -Wno-psabi".split()
AHEAD = PACKAGE / "kernels" / "built"  # libraries that a wheel carries
# By kind of machine, the largest first: what compilers call them, and the flags of /proc/cpuinfo that they need.
INSTRUCTION_SETS: dict[str, dict[str, tuple[str, ...]]] = {
    "x86_64": {
        "x86-64-v4": ("avx2", "fma", "bmi2", "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"),
        "x86-64-v3": ("avx2", "fma", "bmi1", "bmi2", "f16c", "movbe"),
    },
    "aarch64": {"armv8-a": ("asimd",)},
}
_UNFINISHED = "building-"  # folders of builds
_BUILD_TIME = 300  # [s] at most
_OFF = ("0", "off", "false", "no")


def load(
    sources: str | Sequence[str], defines: Mapping[str, str], headers: Mapping[str, str] | None = None
) -> ctypes.CDLL | None:
    """Return a library, which is built if it is not in the cache; a line on stderr then says so.

    The cache is the folder in the environment variable TORCHELEV_CACHE, else `torchelev` in the user's cache folder.

    Args:
        sources: C++ files, seen from the package's folder, where their includes begin too.
        defines: values of the constants that the sources do not define.
        headers: texts of further headers, by name.

    Returns:
        The library; None without a compiler, or with TORCHELEV_NATIVE=0 in the environment. If the compiler fails, a
        warning says so.
    """
    if is_switched_off():
        return None
    sources = (sources,) if isinstance(sources, str) else tuple(sources)
    return _load(sources, tuple(sorted(defines.items())), tuple(sorted((headers or {}).items())))


def is_switched_off() -> bool:
    """Return whether TORCHELEV_NATIVE in the environment forbids to build anything."""
    return os.environ.get("TORCHELEV_NATIVE", "1").lower() in _OFF


@functools.cache
def _load(
    sources: tuple[str, ...], defines: tuple[tuple[str, str], ...], headers: tuple[tuple[str, str], ...]
) -> ctypes.CDLL | None:
    flags = [*_FLAGS, *(f"-D{name}={value}" for name, value in defines)]
    name = Path(sources[0]).stem
    try:
        packaged = AHEAD / f"{name}-{_key(flags, sources, headers)}-{instruction_set()}.so"
        with contextlib.suppress(OSError):  # there is none, or it needs another C library
            return _open(packaged)
        flags.append("-march=native")
        compiler = find_compiler()
        if compiler is None:
            return None
        path = cache_folder() / f"{name}-{_machine_key(compiler, flags, sources, headers)}.so"
        with contextlib.suppress(OSError):  # there is none, or a damaged one
            return _open(path)
        _build(compiler, flags, sources, headers, path)
        return _open(path)
    except (OSError, RuntimeError, subprocess.SubprocessError) as error:  # RuntimeError: a user without a home
        reason = getattr(error, "stderr", None) or error
        warnings.warn(
            f"{name} could not be built, and slower code does its work: {reason}. Set CXX to another compiler, "
            "TORCHELEV_CACHE to a folder that can be written, or TORCHELEV_NATIVE=0 to build nothing.",
            RuntimeWarning,
            stacklevel=2,
        )
        return None


def _open(path: Path) -> ctypes.CDLL:
    """Open a library, whose threads are those of torch's OpenMP where that is GNU's."""
    library = ctypes.CDLL(str(path))
    with contextlib.suppress(AttributeError):  # it keeps no memory
        os.register_at_fork(after_in_child=library.forget_memory)
    with contextlib.suppress(AttributeError):
        library.use_team(ctypes.CDLL(None).GOMP_parallel)
        # A forked child has none of the team's threads, and would wait for them forever.
        os.register_at_fork(after_in_child=functools.partial(library.use_team, None))
    return library


def call(function: Any, *arguments: Any) -> None:
    """Call a library's function.

    Raises:
        IndexError: it returned 1: an index is out of range.
        MemoryError: it returned 2.
    """
    function.restype = ctypes.c_int
    failure = function(*arguments)
    if failure == 1:
        raise IndexError(f"{function.__name__}: an index is out of range")
    if failure:
        raise MemoryError(f"{function.__name__} ran out of memory: give it fewer or smaller maps at a time")


def find_compiler() -> list[str] | None:
    """Return the C++ compiler: the command of the environment variable CXX, else the first that is found.

    Raises FileNotFoundError if CXX names none.
    """
    chosen = shlex.split(os.environ.get("CXX", ""))
    if chosen and not shutil.which(chosen[0]):
        raise FileNotFoundError(f"CXX={os.environ['CXX']} is no command")
    return chosen or next(([name] for name in ("c++", "g++", "clang++") if shutil.which(name)), None)


def cache_folder() -> Path:
    """Return the folder of the built libraries."""
    chosen = os.environ.get("TORCHELEV_CACHE")
    return Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchelev"


def _remove_abandoned(cache: Path) -> None:
    """Remove folders of builds that were killed: older than any build takes."""
    for folder in cache.glob(f"{_UNFINISHED}*"):
        with contextlib.suppress(OSError):
            if time.time() - folder.stat().st_mtime > 2 * _BUILD_TIME:
                shutil.rmtree(folder, ignore_errors=True)


def _build(
    compiler: list[str],
    flags: list[str],
    sources: Sequence[str],
    headers: Sequence[tuple[str, str]],
    path: Path,
) -> None:
    """Compile files side by side and link them; the library appears whole or not at all, if several build it too."""
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_abandoned(path.parent)
    start = time.perf_counter()
    print(f"torchelev: building {path.name} ...", end=" ", file=sys.stderr, flush=True)
    end = "failed"
    try:
        with tempfile.TemporaryDirectory(prefix=_UNFINISHED, dir=path.parent) as name:
            folder = Path(name)
            for header, text in headers:
                (folder / header).write_text(text)
            command = [*compiler, *flags, f"-I{folder}", f"-I{PACKAGE}"]
            objects = [folder / f"{k}.o" for k in range(len(sources))]
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                pairs = zip(sources, objects, strict=True)
                jobs = [pool.submit(_run, [*command, "-c", str(PACKAGE / s), "-o", str(o)]) for s, o in pairs]
                for job in jobs:
                    job.result()
            _run([*command, "-shared", *map(str, objects), "-o", str(folder / path.name)])
            os.replace(folder / path.name, path)
        end = f"done in {time.perf_counter() - start:.0f} s; later processes find it."
    finally:
        print(end, file=sys.stderr, flush=True)


def _run(command: list[str]) -> None:
    subprocess.run(command, check=True, capture_output=True, text=True, timeout=_BUILD_TIME)


def _machine_key(
    compiler: list[str], flags: list[str], sources: Sequence[str], headers: Sequence[tuple[str, str]]
) -> str:
    """Return a hash of all that a library built here depends on: its key, compiler and processor."""
    version = subprocess.run([*compiler, "--version"], check=True, capture_output=True, timeout=60).stdout
    parts = [_key(flags, sources, headers).encode(), version, describe_processor(), " ".join(compiler).encode()]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:16]


def _key(flags: list[str], sources: Sequence[str], headers: Sequence[tuple[str, str]]) -> str:
    """Return a hash of the sources and flags of a library."""
    parts = [" ".join(flags).encode(), *(text.encode() for _, text in headers)]
    parts += [part for source in sources for part in (source.encode(), (PACKAGE / source).read_bytes())]
    parts += [path.read_bytes() for path in sorted(PACKAGE.rglob("*.h"))]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:16]


# Built ahead --------------------------------------------------------------------------------------------------------


def build_ahead(
    sources: str | Sequence[str], defines: Mapping[str, str], headers: Mapping[str, str] | None = None
) -> list[Path]:
    """Build a library for each instruction set of this machine's kind into AHEAD, as a wheel carries it."""
    compiler, paths = find_compiler(), []
    hint = "install g++ or clang++, or set CXX"
    require(compiler is not None, "compiler", "must be there to build libraries", "none", hint, FileNotFoundError)
    assert compiler is not None
    sources = (sources,) if isinstance(sources, str) else tuple(sources)
    flags = [*_FLAGS, *(f"-D{name}={value}" for name, value in sorted(defines.items()))]
    texts = tuple(sorted((headers or {}).items()))
    for target in INSTRUCTION_SETS.get(platform.machine(), {}):
        path = AHEAD / f"{Path(sources[0]).stem}-{_key(flags, sources, texts)}-{target}.so"
        if not path.exists():
            _build(compiler, [*flags, f"-march={target}"], sources, texts, path)
        paths.append(path)
    return paths


@functools.cache
def instruction_set() -> str | None:
    """Return the largest of INSTRUCTION_SETS that this processor has; None without any."""
    found = set(describe_processor().split())
    sets = INSTRUCTION_SETS.get(platform.machine(), {})
    return next((name for name, flags in sets.items() if {flag.encode() for flag in flags} <= found), None)


def describe_processor() -> bytes:
    """Describe the processor, as -march=native makes code for this one."""
    try:
        lines = Path("/proc/cpuinfo").read_bytes().splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}".encode()
    return b"\n".join(sorted({line for line in lines if line.startswith((b"model name", b"flags", b"Features"))}))
