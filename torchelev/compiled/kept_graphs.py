"""Compiled graphs kept on disk: a later process loads what an earlier one compiled, and traces nothing."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import os
import platform
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map

from torchelev.compiled.compiler import (
    LoadedGraph,
    announced_start,
    compiled,
    load_traced,
    mark_dynamic,
    remove_marks,
    traced,
)
from torchelev.native.library import describe_processor, is_native
from torchelev.output_files import atomic_file

NUM_KEPT = 2  # kinds of arguments with a graph of their own: chunks have one size, but for the last
EXAMPLE = 2**16  # size of dimensions that vary, over all environments: enough to be worth several threads
_VARIABLES = ("TORCHINDUCTOR", "TORCHDYNAMO", "ATEN_CPU", "CXX")  # beginnings of those that change what is compiled
_STALE = 60  # [s] age beyond which an empty library counts as abandoned
_TIMEOUT = 600  # [s] to wait for another process that compiles the same
_SOURCES = Path(__file__).parents[1]


class Dynamic(NamedTuple):
    """Arguments that may differ in size from call to call."""

    dim: int  #: whose size it is
    values: Sequence[Tensor | None]  #: who has it
    multiple: int = 1  #: the size is a multiple of this


class KeptGraph:
    """A function as one compiled graph, which later processes find in the compiler's cache folder.

    Each of the first NUM_KEPT kinds of arguments, mostly numbers of environments, has a graph of its own. Others go to
    `torch.compile`, and so does everything where no graph can be kept.

    Args:
        function: takes a NamedTuple of tensors first, whose first size is the number of environments.
        settings: all that the graph depends on besides its arguments and torchelev's code.
        dynamic: returns, of the arguments, what may differ in size from call to call.
    """

    def __init__(self, function: Callable[..., Any], settings: Any, dynamic: Callable[..., Dynamic]) -> None:
        self._function, self._dynamic = function, dynamic
        self._settings = describe(settings)
        self._usual = compiled(function)
        self._kept: dict[tuple[Any, ...], LoadedGraph | None] = {}

    def __call__(self, *args: Any) -> Any:
        """Call the function."""
        if torch.compiler.is_compiling():  # a graph of the caller's own takes it in
            return self._function(*args)
        graph = self.prepare(*args)
        if graph is not None and graph.guard_check(*args):
            return graph.fn(*args)
        dynamic = self._dynamic(*args)
        mark_dynamic(dynamic.dim, dynamic.values)
        try:
            return self._usual(*args)
        finally:
            remove_marks(dynamic.values)

    def prepare(self, *args: Any) -> LoadedGraph | None:
        """Return the graph for arguments, from its file or compiled into it; None if it cannot be kept."""
        kind = _kind(args)
        if self._is_new(kind):
            with _one_thread_at_a_time():
                if self._is_new(kind):
                    self._kept[kind] = self._find(args)
        return self._kept.get(kind)

    def is_missing(self, *args: Any) -> bool:
        """Tell whether the graph for arguments could be kept, but is neither loaded nor on disk."""
        path = self.path(*args) if self._is_new(_kind(args)) else None
        return path is not None and not path.exists()

    def _is_new(self, kind: tuple[Any, ...]) -> bool:
        return kind not in self._kept and len(self._kept) < NUM_KEPT

    def path(self, *args: Any) -> Path | None:
        """Return the file for arguments; None if there can be none."""
        if self._settings is None or not can_keep(args[0][0].device):
            return None
        dim, values, _ = self._dynamic(*args)
        of_tensors = [_describe_tensor(v, dim if any(v is w for w in values) else None) for v in tree_leaves(args)]
        try:
            return _folder() / f"{_hash(self._settings, str(of_tensors), surroundings())}.graph"
        except OSError:  # the folder cannot be made
            return None

    def _find(self, args: Sequence[Any]) -> LoadedGraph | None:
        path = self.path(*args)
        if path is None:
            return None
        graph = _load(path)
        if graph is not None:
            return graph
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with announced_start(), _one_process_at_a_time(path):
                graph = _load(path)
                if graph is None:
                    remove_unfinished(path.parents[1])
                    examples = self._examples(args)
                    dynamic = self._dynamic(*examples)
                    mark_dynamic(dynamic.dim, dynamic.values)
                    data = traced(self._function, examples)
                    graph = load_traced(data)
                    with atomic_file(path) as file:
                        file.write(data)
        except Exception as error:  # of the folder, or of a compiler whose interface is young
            warnings.warn(
                f"the compiled update could not be stored in {path}; each process will compile it again. Cause: "
                f"{error!r}. If the folder is not writable, set TORCHINDUCTOR_CACHE_DIR",
                RuntimeWarning,
                stacklevel=2,
            )
        return graph

    def _examples(self, args: Sequence[Any]) -> tuple[Any, ...]:
        """Return the arguments with a usual size where it may vary, so that the first call's does not decide."""
        dim, values, multiple = self._dynamic(*args)
        size = multiple * max(2, EXAMPLE // (multiple * max(1, len(args[0][0]))))

        def resized(value: Tensor | None) -> Tensor | None:
            if value is None or not any(value is other for other in values):
                return value
            return _resized(value, dim, size)

        return tree_map(resized, tuple(args))


def _resized(value: Tensor, dim: int, size: int) -> Tensor:
    """Return zeros of another size along a dimension, laid out in memory in the same order."""
    shape, unit = _layout(value, dim)
    shape[dim], strides = size, [stride * (size if spans else 1) for stride, spans in unit]
    with torch.inference_mode(value.is_inference()):
        return torch.empty_strided(shape, strides, dtype=value.dtype, device=value.device).zero_()


def _layout(value: Tensor, dim: int | None) -> tuple[list[int], list[tuple[int, bool]]]:
    """Return the shape, 0 along a dimension, and the strides: in units of its size those that span it."""
    shape, strides = list(value.shape), value.stride()
    if dim is None:
        return shape, [(stride, False) for stride in strides]
    extent, shape[dim] = strides[dim] * shape[dim], 0
    spans = [k != dim and stride >= extent for k, stride in enumerate(strides)]
    return shape, [(s // value.shape[dim] if far else s, far) for s, far in zip(strides, spans, strict=True)]


def _load(path: Path) -> LoadedGraph | None:
    """Return the graph in a file; None if there is none of use."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    try:
        return load_traced(data)
    except Exception:  # a damaged file raises whatever its bytes say
        return None


def _kind(args: Sequence[Any]) -> tuple[Any, ...]:
    """Return what tells the graphs of a process apart: number of environments, threads and dtypes."""
    first = args[0]
    return (len(first[0]), torch.get_num_threads(), *(value.dtype for value in first if isinstance(value, Tensor)))


def _describe_tensor(value: Tensor | None, dynamic: int | None) -> Any:
    if value is None:
        return None
    return _layout(value, dynamic), str(value.dtype), str(value.device), value.is_inference()


def can_keep(device: torch.device) -> bool:
    """Tell whether this torch can store compiled graphs for a device, as far as that was tested."""
    return device.type == "cpu" and torch.__version__ >= "2.13" and torch.__version__ < "2.14"


def describe(value: Any) -> str | None:
    """Describe settings so that equal descriptions mean equal graphs; None if that is not known.

    Objects of foreign classes have code that torchelev does not know.
    """
    if value is None or isinstance(value, (bool, int, float, str, Path, torch.dtype, torch.device)):
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
        with contextlib.suppress(OSError):  # another process may remove it, too
            found = path.stat()
            if found.st_size == 0 and time.time() - found.st_mtime > _STALE:
                path.unlink(missing_ok=True)


def _one_thread_at_a_time() -> contextlib.AbstractContextManager[Any]:
    from torch._dynamo.convert_frame import compile_lock  # which `torch.compile` holds while it compiles

    return compile_lock


def _one_process_at_a_time(path: Path) -> contextlib.AbstractContextManager[Any]:
    from torch.utils._filelock import FileLock

    return FileLock(f"{path}.lock", timeout=_TIMEOUT)


def _folder() -> Path:
    from torch._inductor.runtime.cache_dir_utils import cache_dir  # as slow to import as the compiler

    return Path(cache_dir()) / "torchelev"


def surroundings() -> str:
    """Describe what else a graph depends on: this process."""
    from torch._C._dynamo.guards import GlobalStateGuard
    from torch._inductor import config

    variables = sorted(item for item in os.environ.items() if item[0].startswith(_VARIABLES))
    variables = [item for item in variables if item[0] != "TORCHINDUCTOR_CACHE_DIR"]
    state: Any = GlobalStateGuard()
    options = sorted(config.save_config_portable(ignore_private_configs=False).items())  # as torch's own cache has them
    code = f"{_installation()} {is_native()}"
    return f"{code} {state.__getstate__()!r} {torch.get_default_device()} {options} {variables}"


@functools.cache
def _installation() -> str:
    """Describe Python, torch, the processor and torchelev's code."""
    code = (path.read_bytes() for path in sorted(_SOURCES.rglob("*.py")))
    return _hash(platform.python_version(), torch.__version__, describe_processor(), *code)


def _hash(*parts: str | bytes) -> str:
    data = (part if isinstance(part, bytes) else part.encode() for part in parts)
    return hashlib.sha256(b"\0".join(data)).hexdigest()[:24]
