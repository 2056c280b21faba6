"""torch.compile with the options that pay off here, announced, and with guards on arguments alone."""

from __future__ import annotations

import contextlib
import io
import itertools
import pickle
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from types import FunctionType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchelev.compiled.mask_bytes import choose_bytes_as_integers, pass_bytes_on

KERNEL_ARGUMENTS = 16  # measured: 12 to 24 do as well
PATCHES = 2  # version of the patches of the compiler below, which its cache does not see: raise it with each change


def inductor(graph: torch.fx.GraphModule, inputs: list[Any]) -> Callable[..., Any]:
    """Compile by torch's compiler, with what pays off here, as far as this torch knows it."""
    from torch._inductor import compile, config  # takes a second to import, which only compiling needs

    options: dict[str, Any] = {}
    devices = {value.device.type for value in inputs if isinstance(value, Tensor)}
    if devices <= {"cpu"}:
        # What is read so often, or takes so many operations, is stored unasked. The usual limits, which other devices
        # keep, are so low that all sums over a window are stored.
        options |= {"realize_reads_threshold": 20, "realize_opcount_threshold": 120}
    elif "cuda" in devices and torch.__version__ >= "2.11":
        # Kernels that need nothing of each other become one: half of them are shorter than a launch. Tried with 2.11.
        options["combo_kernels"] = True
    if hasattr(config.cpp, "enable_tiling_heuristics"):
        # The compiler gives up vectorisation on many gathers, which pays off in the loops over points.
        options["cpp.enable_tiling_heuristics"] = False
    # Inputs are checked before, and torch's `opcheck` vouches in the tests for what operators return; checking the
    # shapes and addresses of all that in every update takes time.
    options |= {name: False for name in ("size_asserts", "alignment_asserts") if hasattr(config, name)}
    choose_bytes_as_integers(graph)
    pass_bytes_on(graph)
    cache = torch.compiler.config
    tag = cache.patch(cache_key_tag=f"{cache.cache_key_tag}torchelev {PATCHES}")  # type: ignore[attr-defined]
    with short_kernels(), fast_mask_loads(), tag:
        return compile(graph, inputs, options)


@contextlib.contextmanager
def replaced(owner: Any, name: str, change: Callable[[Any], Any]) -> Iterator[None]:
    """Let an attribute of the compiler be what `change` makes of it for a while, as far as this torch has it."""
    usual = getattr(owner, name, None)
    if usual is None:
        yield
        return
    setattr(owner, name, change(usual))
    try:
        yield
    finally:
        setattr(owner, name, usual)


def short_kernels() -> contextlib.AbstractContextManager[None]:
    """Let the compiler end a C++ function after so many arguments; it has no option for this.

    A function holds all that it stores until its end. One of all the loops between two operators takes 32 MB in place
    of 13 with the learned head, and half a millisecond more, as that is more than the caches hold.
    """
    from torch._inductor.codegen.cpp import CppScheduling

    return replaced(CppScheduling, "MAX_FUSED_KERNEL_ARGS_NUM", lambda _: KERNEL_ARGUMENTS)


def fast_mask_loads() -> contextlib.AbstractContextManager[None]:
    """Let the compiler load eight bytes of a mask into a vector of 256 bits directly.

    Torch's `loadu` with a number copies them into 32 bytes and loads those, which waits for the copy: ten times the
    time, and a quarter of what the kernels of an update of 64 robots take. Vectors of 512 bits have no such detour.
    """
    from torch._inductor.codegen.cpp import CppVecKernel
    from torch._inductor.cpu_vec_isa import VecAVX2

    def change(usual: Callable[..., str]) -> Callable[..., str]:
        def load(kernel: Any, *args: Any, **options: Any) -> str:
            line = usual(kernel, *args, **options)
            if not isinstance(kernel.vec_isa, VecAVX2) or kernel.tiling_factor != 8:
                return line
            return re.sub(r"(<uint8_t>::)loadu\((.*), static_cast<int64_t>\(8L?\)\)$", r"\1loadu_one_fourth(\2)", line)

        return load

    return replaced(CppVecKernel, "_get_vec_load_line", change)


_number = itertools.count()


def own_code(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with a code object of its own.

    The compiler finds its graphs by code object and guards. Functions that differ by what they enclose alone, which no
    guard looks at here, would be given each other's graphs; of one code object it keeps no more than eight, and lets
    sizes vary that differ from those before.
    """
    assert isinstance(function, FunctionType)
    code = function.__code__.replace(co_name=f"{function.__name__}_{next(_number)}")
    return FunctionType(code, function.__globals__, code.co_name, function.__defaults__, function.__closure__)


def compiled(
    function: Callable[..., Any], choose_guards: Callable[[Sequence[Any]], list[bool]] | None = None
) -> Callable[..., Any]:
    """Return the function as one compiled graph; call what it returns under `announced_compilation`."""
    options: dict[str, Any] = {}
    if hasattr(torch.compiler, "skip_guard_on_globals_unsafe"):
        options["guard_filter_fn"] = choose_guards or guards_on_arguments
    return torch.compile(own_code(function), fullgraph=True, backend=inductor, options=options)


def guards_on_arguments(guards: Sequence[Any]) -> list[bool]:
    """Choose which guards are checked before each call: not those on code and config, which are frozen.

    Checking these hundreds took a third of a millisecond.
    """
    fixed = ("cfg", "stages", "__dict__")
    return [not guard.is_global and not any(name in guard.name for name in fixed) for guard in guards]


def traced(function: Callable[..., Any], args: Sequence[Any]) -> bytes:
    """Compile a function for arguments into bytes, which `load_traced` loads in any process."""
    from torch._dynamo.aot_compile import AOTCompiledFunction
    from torch._inductor.cpu_vec_isa import valid_vec_isa_list

    compiler: Any = compiled(function, guards_on_kept_arguments)
    graph = AOTCompiledFunction.serialize(compiler.aot_compile((tuple(args), {}))).serialized_data
    return pickle.dumps(([str(isa) for isa in valid_vec_isa_list()], graph))


class LoadedGraph(NamedTuple):
    """A function compiled for arguments of one kind."""

    guard_check: Callable[..., bool]  #: tells whether arguments are of that kind
    fn: Callable[..., Any]  #: the function; call it only with such arguments


def load_traced(data: bytes) -> LoadedGraph:
    """Return the function that `traced` compiled; it may raise anything if the bytes are damaged."""
    instructions, graph = pickle.loads(data)
    with known_instructions(instructions):
        loaded: Any = torch.compiler.load_compiled_function(io.BytesIO(graph))
    return LoadedGraph(_guard_of(loaded), loaded.fn)


def _guard_of(graph: Any) -> Callable[..., bool]:
    """Return a test of a graph's arguments. It does what the graph's `guard_check` does, in a third of the time."""
    artifacts = graph._artifacts
    environment = artifacts.runtime_env
    cells = [cell.cell_contents for cell in environment.closure or ()]
    outer = dict(zip(environment.bytecode.co_freevars, cells, strict=True))
    parameters = artifacts.signature.parameters.values()
    named = [p.name for p in parameters if p.kind != p.VAR_POSITIONAL]
    rest = next((p.name for p in parameters if p.kind == p.VAR_POSITIONAL), None)
    check: Callable[[dict[str, Any]], bool] = artifacts.guard_manager.root.check

    def accepts(*args: Any) -> bool:
        values = {**outer, **dict(zip(named, args, strict=False))}
        if rest is not None:
            values[rest] = args[len(named) :]
        return check(values)

    return accepts


def known_instructions(names: Sequence[str]) -> contextlib.AbstractContextManager[None]:
    """Let the compiler take vector instructions as given, which it else tries out in new processes for a second."""
    from torch._inductor import cpu_vec_isa

    known = [isa for isa in cpu_vec_isa.supported_vec_isa_list if str(isa) in names]
    if len(known) < len(names):  # of processors where it need not try
        return contextlib.nullcontext()
    return replaced(cpu_vec_isa, "valid_vec_isa_list", lambda _: lambda: known)


def guards_on_kept_arguments(guards: Sequence[Any]) -> list[bool]:
    """Choose which guards are kept with a graph: of those on arguments and torch's modes, what can be written.

    Left out are those on classes and identities: arguments are always tuples of the same classes.
    """
    from torch._dynamo.guards import CheckFunctionManager

    lost = (*CheckFunctionManager.UNSUPPORTED_SERIALIZATION_GUARD_TYPES, "CLASS_MATCH")
    kept = guards_on_arguments(guards)
    return [keep and guard.guard_type not in lost for keep, guard in zip(kept, guards, strict=True)]


@contextlib.contextmanager
def announced_compilation() -> Iterator[None]:
    """Say on stderr what is going on for minutes, and what it cost, if anything is compiled."""
    from torch._dynamo.callback import callback_handler

    starts: list[float] = []

    def announce(*_: Any) -> None:
        if not starts:
            print("torchelev: compiling the update, for about a minute ...", end=" ", file=sys.stderr, flush=True)
        starts.append(time.perf_counter())

    callback_handler.register_start_callback(announce)
    end = "failed"
    try:
        yield
        if starts:
            end = f"done in {time.perf_counter() - starts[0]:.0f} s. Later processes find it in the compiler's cache."
    finally:
        if announce in callback_handler.start_callbacks:  # a reset of the compiler clears them
            callback_handler.remove_start_callback(announce)
        if starts:
            print(end, file=sys.stderr, flush=True)


def announced_start() -> contextlib.AbstractContextManager[Any]:
    """Let `announced_compilation` say that something is compiled, which `aot_compile` does not tell it."""
    from torch._dynamo.callback import CallbackTrigger, callback_handler

    return callback_handler.install_callbacks(CallbackTrigger.DYNAMO, "to keep")


def mark_dynamic(dim: int, values: Sequence[Tensor | None]) -> None:
    """Let the size along a dimension differ from call to call."""
    for value in values:
        if value is not None:
            torch._dynamo.maybe_mark_dynamic(value, dim)


def remove_marks(values: Sequence[Tensor | None]) -> None:
    """Undo `mark_dynamic`: a graph from disk refuses tensors with marks."""
    for value in values:
        for name in ("_dynamo_weak_dynamic_indices", "_has_dynamo_dim_marking"):
            getattr(value, "__dict__", {}).pop(name, None)


def packed(value: Tensor) -> Tensor:
    """Return the values as a tensor of its own, with the strides of a new one; they are copied only if they must be.

    A slice, an expansion, or what was made in inference mode would get other graphs, and so would views of other bases.
    Call it outside of inference mode, and without gradients.
    """
    value = value.contiguous().reshape(-1).view(value.shape)  # constants expanded in full would else stay so
    if value.is_inference():
        return value.clone()
    place = value.untyped_storage(), value.storage_offset(), value.shape, value.stride()
    return value.new_empty(0).set_(*place)
