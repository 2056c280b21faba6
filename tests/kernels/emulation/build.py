"""A CUDA source as a library for the CPU."""

import ctypes
import functools
import hashlib
import os
import re
import subprocess
import tempfile
from pathlib import Path

from torchelev.kernels.cpu_build import find_compiler

_HERE = Path(__file__).parent
_THREADS = _HERE / "threads.cpp"
_DEFINES = "-std=c++17", "-D__CUDACC__", "-D__CUDA_ARCH__=900"  # what sources ask
_FLAGS = "-std=c++17 -O1 -g1 -fPIC -shared -U_FORTIFY_SOURCE -w -fsanitize=undefined -static-libubsan".split()
_SHARED_BY_LAUNCH = re.compile(r"extern\s+__shared__\s+(?:alignas\s*\([^)]*\)\s*)?([^;\[]+?)\s*\b(\w+)\s*\[\s*\]\s*;")
_KERNEL = re.compile(r"__global__[^;{]*?\bvoid\s+(\w+)\s*\(")
_ENTRY = """
extern "C" void emulated_{0}(void** arguments) {{ emulation::Kernel<{0}>::run(arguments); }}
extern "C" const int64_t* sizes_{0}() {{ return emulation::Kernel<{0}>::sizes; }}
"""


@functools.cache
def build(path: Path, include_dirs: tuple[Path, ...]) -> ctypes.CDLL:
    """Return a CUDA source as a library, which all processes that run tests share."""
    text = _for_cpu(_preprocess(path, include_dirs))
    parts = [text, _THREADS.read_text(), " ".join([*find_compiler(), *_FLAGS])]
    key = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"torchelev-emulation-{os.getuid()}"
    built = folder / f"{path.stem}-{key}.so"
    if not built.exists():
        folder.mkdir(exist_ok=True)
        _compile(text, built)
    return ctypes.CDLL(str(built))


def kernels_of(text: str) -> list[str]:
    """Return the names of a source's kernels."""
    return _KERNEL.findall(text)


def _preprocess(path: Path, include_dirs: tuple[Path, ...]) -> str:
    includes = ["-include", str(_HERE / "gpu.h"), *(f"-I{folder}" for folder in (path.parent, *include_dirs))]
    return _run(*_DEFINES, "-E", *includes, "-x", "c++", str(path))


def _for_cpu(text: str) -> str:
    """Replace what only CUDA has; add what `emulation_launch` calls. Blocks run one after the other, in one thread."""
    entries = "".join(_ENTRY.format(name) for name in kernels_of(text))
    text = _SHARED_BY_LAUNCH.sub(r"\1* \2 = static_cast<\1*>(emulation::shared_memory());", text)
    return re.sub(r"\b__global__\b", "", re.sub(r"\b__shared__\b", "static thread_local", text)) + entries


def _compile(text: str, built: Path) -> None:
    with tempfile.TemporaryDirectory(dir=built.parent) as folder:
        source, library = Path(folder) / "kernels.ii", Path(folder) / "kernels.so"
        source.write_text(text)
        _run(*_FLAGS, str(source), str(_THREADS), "-o", str(library))
        os.replace(library, built)


def _run(*options: str) -> str:
    done = subprocess.run([*find_compiler(), *options], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"the CUDA source does not compile as C++:\n{done.stderr}")
    return done.stdout
