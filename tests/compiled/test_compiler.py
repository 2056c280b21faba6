"""The compiler's options hold while it compiles, and pay off in its code."""

import re

import pytest
import torch
from torch._dynamo.callback import callback_handler
from torch._inductor import config as inductor_config
from torch._inductor.codegen.cpp import CppScheduling
from torch._inductor.cpu_vec_isa import VecAVX2, pick_vec_isa
from torch._inductor.utils import run_and_get_code

from torchelev.compiled.compiler import KERNEL_ARGUMENTS, announced_compilation, compiled
from torchelev.compiled.mask_bytes import choose_bytes_as_integers, pass_bytes_on
from torchelev.ops.moving import move_in_place
from torchelev.ops.storage import as_bytes, as_mask
from torchelev.traversability import planes

pytestmark = pytest.mark.compiles


def test_the_compiler_is_left_as_it_was(monkeypatch, capsys):
    seen, usual = [], CppScheduling.MAX_FUSED_KERNEL_ARGS_NUM

    def fails(*_):
        seen.append(CppScheduling.MAX_FUSED_KERNEL_ARGS_NUM)
        raise ArithmeticError("of the compiler")

    monkeypatch.setattr("torch._inductor.compile", fails)
    with pytest.raises(Exception, match="of the compiler"), announced_compilation():
        compiled(lambda x: x + 1)(torch.ones(2))
    assert seen == [KERNEL_ARGUMENTS] and usual > KERNEL_ARGUMENTS
    assert usual == CppScheduling.MAX_FUSED_KERNEL_ARGS_NUM
    assert "failed" in capsys.readouterr().err
    assert not callback_handler.start_callbacks


@pytest.mark.slow(3)
def test_eight_bytes_of_a_mask_are_loaded_at_once():
    """Also where the rest of the mask is fewer than eight, and where the vectors are longer."""

    def chosen(mask, values):
        return torch.where(mask.bool(), values, -values)

    generator = torch.Generator().manual_seed(0)
    for number in (8, 64, 2003):
        mask = torch.randint(2, (number,), generator=generator, dtype=torch.uint8)
        values = torch.randn(number, generator=generator)
        with inductor_config.patch(force_disable_caches=True):
            result, codes = run_and_get_code(compiled(chosen), mask, values)
        assert torch.equal(result, chosen(mask, values))
        if isinstance(pick_vec_isa(), VecAVX2):
            code = "".join(codes)
            assert "<uint8_t>::loadu_one_fourth(" in code
            assert re.search(r"<uint8_t>::loadu\(.*<int64_t>\(8L?\)\)", code) is None


def test_bytes_are_chosen_as_integers_in_graphs_that_the_cache_accepts():
    """It keeps no graph with a method call on a node without an example value."""
    graphs = []

    def keep(graph, _):
        choose_bytes_as_integers(graph)
        graphs.append(graph)
        return graph.forward

    def chosen(mask, one, other):
        return torch.where(mask, torch.where(~mask, one, 7), other)

    mask, one, other = torch.tensor([True, False]), torch.tensor([200, 3]).byte(), torch.tensor([5, 255]).byte()
    torch._dynamo.reset()
    assert torch.equal(torch.compile(chosen, backend=keep)(mask, one, other), chosen(mask, one, other))
    nodes = [node for node in graphs[0].graph.nodes if node.op.startswith("call")]
    assert all(n.meta["example_value"].dtype == torch.int32 for n in nodes if n.target is torch.where)
    assert all("example_value" in node.meta for node in nodes)


def rewritten(function, *arguments):
    """What a function's graph returns and makes of its arguments, before the pass and after; and the graph after it."""
    graphs, results = [], []
    for change in (lambda graph: None, pass_bytes_on):

        def keep(graph, _, change=change):
            change(graph)
            graphs.append(graph)
            return graph.forward

        torch._dynamo.reset()
        values = [value.clone() for value in arguments]
        results.append([torch.compile(function, backend=keep)(*values), *values])
    return results, graphs[1]


STORED, OTHER = torch.tensor([[[1, 0, 0, 1]]]).byte(), torch.zeros(1, 1, 4).byte()


def test_bytes_are_passed_on():
    def copy(stored, other):
        mask = as_mask(stored)
        other.copy_(as_bytes(mask))
        stored.copy_(as_bytes(~mask))
        return as_bytes(mask & (other > 0))

    (usual, got), graph = rewritten(copy, STORED, OTHER)
    assert all(map(torch.equal, got, usual))
    assert next(n for n in graph.graph.nodes if n.target == "copy_").args[1].op == "placeholder"


def test_bytes_are_passed_on_to_what_writes_into_other_tensors():
    def write(stored, other):
        mask = as_mask(stored)
        planes._write_planes(torch.zeros(1, 1, 4), as_bytes(mask), *_written(other))
        return other + as_bytes(mask & (other > 0))

    (usual, got), graph = rewritten(write, STORED, OTHER)
    assert all(map(torch.equal, got, usual))
    writes = torch.ops.torchelev.write_planes.default
    assert graph.graph.find_nodes(op="call_function", target=writes)[0].args[1].op == "placeholder"


def test_bytes_are_not_passed_on_to_what_writes_them():
    def write(stored, other):
        planes._write_planes(torch.zeros(1, 1, 4), as_bytes(as_mask(stored)), *_written(stored))
        return other + stored

    (usual, got), graph = rewritten(write, STORED, OTHER)
    assert all(map(torch.equal, got, usual))
    node = graph.graph.find_nodes(op="call_function", target=torch.ops.torchelev.write_planes.default)[0]
    assert node.args[1] is not node.args[2][2]


def _then(change):
    def copy(stored, other):
        mask = as_mask(stored)
        change(stored)
        other.copy_(as_bytes(mask))
        return other + 1

    return copy


def _written(mask):
    return [torch.empty(1, 1, 4), torch.empty(1, 1, 4), mask], 1, 0, 0.1, []


def _change_result(stored, other):
    result = as_bytes(as_mask(stored))
    result.zero_()
    return result + 1


def _set(stored):
    stored[..., :1] = 0


def _add(stored):
    stored += 1


@pytest.mark.parametrize(
    "function",
    [
        _then(lambda stored: move_in_place([stored], torch.tensor([[0, 1]]), [0.0])),
        _then(lambda stored: stored.zero_()),
        _then(lambda stored: stored.view(-1).zero_()),
        _then(lambda stored: torch.bitwise_xor(stored, stored, out=stored)),
        _then(lambda stored: planes._write_planes(torch.zeros(1, 1, 4), stored, *_written(stored))),
        _then(_set),
        _then(_add),
        _change_result,
        lambda stored, other: as_bytes(as_mask(stored)),  # which must be no argument
        lambda stored, other: as_bytes((stored + 4).to(torch.int32) > 0) + 1,  # a count
        lambda stored, other: as_bytes(as_mask(stored.float() * 0.5)) + 1,
    ],
)
def test_bytes_are_not_passed_on_where_they_change_or_are_no_mask(function):
    (usual, got), graph = rewritten(function, STORED, OTHER)
    assert all(map(torch.equal, got, usual))
    assert all(got[0] is not argument for argument in got[1:])
