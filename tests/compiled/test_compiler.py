"""The compiler's options hold while it compiles, and pay off in its code."""

import re

import pytest
import torch
from torch._dynamo.callback import callback_handler
from torch._inductor import config as inductor_config
from torch._inductor.codegen.cpp import CppScheduling
from torch._inductor.cpu_vec_isa import VecAVX2, pick_vec_isa
from torch._inductor.utils import run_and_get_code

from torchelev.compiled.compiler import (
    KERNEL_ARGUMENTS,
    announced_compilation,
    choose_bytes_as_integers,
    compiled,
    pass_bytes_on,
)
from torchelev.ops.moving import move_in_place
from torchelev.ops.storage import as_bytes, as_mask

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


@pytest.mark.parametrize("moves", [False, True])
def test_bytes_are_passed_on_unless_they_change_meanwhile(moves):
    graphs = []

    def keep(graph, _):
        pass_bytes_on(graph)
        graphs.append(graph)
        return graph.forward

    def copy(stored, other, shift):
        mask = as_mask(stored)
        if moves:
            move_in_place([stored], shift, [0.0])
        other.copy_(as_bytes(mask))
        stored.copy_(as_bytes(~mask))
        return as_bytes(mask & (other > 0))

    torch._dynamo.reset()
    stored, other = torch.tensor([[[1, 0, 0, 1]]]).byte(), torch.zeros(1, 1, 4).byte()
    result = torch.compile(copy, backend=keep)(stored, other, torch.tensor([[0, 1]]))
    assert other.tolist() == [[[1, 0, 0, 1]]] and stored.tolist() == [[[0, 1, 1, 0]]] and torch.equal(result, other)
    (target, source) = next(n.args for n in graphs[0].graph.nodes if n.target == "copy_")
    assert (source.op == "placeholder") == (not moves)
