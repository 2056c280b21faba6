"""Compiled graphs kept on disk: a later process loads what an earlier one compiled, and traces nothing."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import os
import pickle
import platform
import subprocess
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch

from torchelev.compiled.compiler import compiled, load_traced, mark_dynamic, remove_marks, traced
from torchelev.native.library import describe_processor
from torchelev.output_files import atomic_file

NUM_KEPT = 2  # numbers of environments with a graph of their own: chunks have one size, but for the last
_VARIABLES = ("TORCH", "ATEN_", "OMP_", "CXX")  # beginnings of environment variables that may change what is compiled
_STALE = 60  # [s] after which nobody writes an empty library any more
_SOURCES = Path(__file__).parents[1]


class KeptGraph:
    """A function as one compiled graph, which later processes find in the compiler's cache folder.

    Each of the first NUM_KEPT numbers of environments has a graph of its own. What else differs between two calls, such
    as the number of threads, goes to `torch.compile`.

    Args:
        function: takes a NamedTuple of tensors first, whose first size is the number of environments.
        settings: all that the graph depends on besides torchelev's code and what its guards check.
        dynamic: returns, of the arguments, the dimension whose size may differ from call to call, and who has it.
    """

    def __init__(self, function: Callable[..., Any], settings: Any, dynamic: Callable[..., Any]) -> None:
        self._function, self._dynamic = function, dynamic
        self._settings = describe(settings)
        self._usual = compiled(function)
        self._kept: dict[tuple[Any, ...], Any] = {}
        self.helper: subprocess.Popen[bytes] | None = None  #: a process that writes the file

    def __call__(self, *args: Any) -> Any:
        """Call the function."""
        graph = self.prepare(*args)
        if graph is not None and graph.guard_check(*args):
            return graph.fn(*args)
        mark_dynamic(*self._dynamic(*args))
        return self._usual(*args)

    def prepare(self, *args: Any) -> Any:
        """Return the graph from the file, which is compiled if it is not there; None if it cannot be kept."""
        kind = _kind(args)
        if self.is_new(*args):
            path = self._path(kind)
            self._kept[kind] = None if path is None else self._find(path, args)
        return self._kept.get(kind)

    def is_new(self, *args: Any) -> bool:
        """Tell whether this process has not looked for the graph yet."""
        return _kind(args) not in self._kept and len(self._kept) < NUM_KEPT

    def is_missing(self, *args: Any) -> bool:
        """Tell whether the graph can be kept, but is not yet."""
        path = self._path(_kind(args))
        return path is not None and not path.exists()

    def _path(self, kind: tuple[Any, ...]) -> Path | None:
        """Return the file for a kind of arguments; None if there can be none."""
        if self._settings is None or not can_keep(kind[-1]):
            return None
        return _folder() / f"{_hash(self._settings, str(kind), _surroundings())}.graph"

    def _find(self, path: Path, args: Sequence[Any]) -> Any:
        graph = _load(path)
        if graph is None and self.helper is not None:
            self.helper.wait()
            graph = _load(path)
        if graph is None and self._write(path, args):
            graph = _load(path)
        return graph

    def _write(self, path: Path, args: Sequence[Any]) -> bool:
        """Compile the graph into a file; return whether it could be kept."""
        dim, values = self._dynamic(*args)
        mark_dynamic(dim, values)
        try:
            remove_unfinished(path.parents[1])
            data = traced(self._function, args)
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_file(path) as file:
                file.write(data)
        except (OSError, pickle.PicklingError, torch._dynamo.exc.PackageError) as error:
            warnings.warn(
                f"{path}: cannot be written, so each process will compile the update anew: {error}. Set "
                "TORCHINDUCTOR_CACHE_DIR to a folder that can be written.",
                RuntimeWarning,
                stacklevel=2,
            )
            return False
        finally:
            remove_marks(values)
        return True


def _load(path: Path) -> Any:
    """Return the graph in a file; None if there is none, or none of use."""
    try:
        return load_traced(path.read_bytes())
    except OSError:
        return None
    except Exception:  # a damaged file raises whatever its bytes say
        with contextlib.suppress(OSError):
            path.unlink()
        return None


def _kind(args: Sequence[Any]) -> tuple[Any, ...]:
    """Return what tells the graphs of one function apart: number of environments, dtype and device."""
    first = args[0][0]
    return len(first), first.dtype, first.device


def can_keep(device: torch.device) -> bool:
    """Tell whether this torch can write and load graphs for a device."""
    return device.type == "cpu" and torch.__version__ >= "2.13"


def describe(value: Any) -> str | None:
    """Describe settings so that equal descriptions mean equal graphs; None if that is not known.

    Objects of foreign classes have code that torchelev does not know.
    """
    if value is None or isinstance(value, (bool, int, float, str, torch.dtype, torch.device)):
        return repr(value)
    if dataclasses.is_dataclass(value) and type(value).__module__.startswith("torchelev."):
        parts: Iterable[Any] = (getattr(value, field.name) for field in dataclasses.fields(value))
    elif isinstance(value, (tuple, list, frozenset)):
        parts = sorted(value, key=repr) if isinstance(value, frozenset) else value
    else:
        return None
    described = [describe(part) for part in parts]
    if None in described:
        return None
    return f"{type(value).__qualname__}({', '.join(map(str, described))})"


def remove_unfinished(folder: Path) -> None:
    """Remove the empty libraries that a killed compilation left: every later start would fail on them."""
    for path in folder.rglob("*.so"):
        found = path.stat()
        if found.st_size == 0 and time.time() - found.st_mtime > _STALE:
            path.unlink(missing_ok=True)


def _folder() -> Path:
    from torch._inductor.runtime.cache_dir_utils import cache_dir  # as slow to import as the compiler

    return Path(cache_dir()) / "torchelev"


def _surroundings() -> str:
    """Describe what else a graph depends on: this process."""
    variables = sorted(item for item in os.environ.items() if item[0].startswith(_VARIABLES))
    variables = [item for item in variables if item[0] != "TORCHINDUCTOR_CACHE_DIR"]
    return f"{_installation()} {torch.get_num_threads()} {variables}"


@functools.cache
def _installation() -> str:
    """Describe Python, torch, the processor and torchelev's code."""
    code = (path.read_bytes() for path in sorted(_SOURCES.rglob("*.py")))
    return _hash(platform.python_version(), torch.__version__, describe_processor(), *code)


def _hash(*parts: str | bytes) -> str:
    data = (part if isinstance(part, bytes) else part.encode() for part in parts)
    return hashlib.sha256(b"\0".join(data)).hexdigest()[:24]
