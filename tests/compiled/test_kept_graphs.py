"""Compiled graphs on disk: loaded where they fit, compiled anew where they do not."""

import dataclasses
import os
import time

import pytest
import torch
from torch._inductor import cpu_vec_isa

from tests.helpers import small_config
from torchelev import GridConfig
from torchelev.compiled import kept_graphs
from torchelev.compiled.elsewhere import run_elsewhere
from torchelev.compiled.kept_graphs import KeptGraph, describe, remove_unfinished

pytestmark = [
    pytest.mark.compiles,
    pytest.mark.skipif(not kept_graphs.can_keep(torch.device("cpu")), reason="this torch keeps no graphs"),
]


def add_up(pair, factor):
    return pair[0].sum(1) * factor


@pytest.fixture
def compiled_anew(tmp_path, monkeypatch):
    """Count what is compiled, in a cache of its own."""
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    torch._dynamo.reset()
    usual, count = kept_graphs.traced, []

    def traced(*args):
        count.append(args)
        return usual(*args)

    monkeypatch.setattr(kept_graphs, "traced", traced)
    return count


def graph(settings=(1,)):
    return KeptGraph(add_up, settings, lambda pair, _: (1, pair))


def pair(num_envs=2, number=5, dtype=torch.float32):
    return (torch.arange(num_envs * number, dtype=dtype).view(num_envs, number),)


def call(kept, values, factor=2.0):
    assert torch.equal(kept(values, torch.tensor(factor)), add_up(values, factor))


@pytest.mark.slow(10)
def test_a_graph_is_compiled_once_for_all_processes_and_sizes(compiled_anew, tmp_path):
    frames = torch._dynamo.utils.counters["frames"]["total"]
    first = graph()
    for number in (5, 6, 900):
        call(first, pair(number=number))
    call(graph(), pair(number=7))  # as in a later process
    assert len(compiled_anew) == 1 and len(list(tmp_path.glob("torchelev/*.graph"))) == 1
    assert torch._dynamo.utils.counters["frames"]["total"] == frames, "nothing went to torch.compile"
    call(graph((2,)), pair())
    assert len(compiled_anew) == 2, "other settings"


@pytest.mark.slow(10)
def test_two_numbers_of_environments_are_kept_and_others_share_one_graph(compiled_anew):
    kept = graph()
    for num_envs in (2, 4, 6, 2, 8):
        call(kept, pair(num_envs))
    call(kept, pair(2, dtype=torch.float64))
    assert len(compiled_anew) == 2


@pytest.mark.slow(10)
def test_each_number_of_environments_is_a_constant_of_its_graph(compiled_anew):
    """Also of the second one, which torch.compile would leave open."""
    kept = graph()
    for num_envs in (2, 4):
        call(kept, pair(num_envs))
        found = kept._kept[num_envs, torch.float32, torch.device("cpu")]
        call(kept, pair(num_envs, 9))
        assert found.guard_check(pair(num_envs, 9), torch.tensor(2.0))
        assert not found.guard_check(pair(num_envs + 1, 9), torch.tensor(2.0))


@pytest.mark.slow(10)
def test_what_the_file_does_not_fit_is_compiled_by_the_process(compiled_anew):
    kept = graph()
    call(kept, pair())
    call(kept, (pair(4)[0].view(2, 10)[:, ::2],))  # other strides
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(threads + 1)
        call(kept, pair())
        call(graph(), pair())
    finally:
        torch.set_num_threads(threads)
    assert len(compiled_anew) == 2, "another number of threads has a file of its own"


@pytest.mark.slow(10)
@pytest.mark.parametrize("damage", [b"", b"\x80\x04nonsense", None])
def test_a_damaged_file_is_replaced(compiled_anew, tmp_path, damage):
    call(graph(), pair())
    (path,) = tmp_path.glob("torchelev/*.graph")
    whole = path.read_bytes()
    path.write_bytes(whole[:-100] if damage is None else damage)
    call(graph(), pair())
    assert len(compiled_anew) == 2 and len(path.read_bytes()) > len(whole) / 2


@pytest.mark.slow(10)
def test_a_folder_that_cannot_be_written_is_told_and_the_update_runs(compiled_anew, tmp_path):
    (tmp_path / "torchelev").write_text("a file, not a folder")
    with pytest.warns(RuntimeWarning, match="TORCHINDUCTOR_CACHE_DIR"):
        call(graph(), pair())


@pytest.mark.slow(10)
def test_a_kept_graph_needs_no_trials_of_the_processor(compiled_anew, monkeypatch):
    """The compiler would try its instructions in other processes, for a second."""
    call(graph(), pair())

    def tried(*_):
        raise AssertionError("tried")

    monkeypatch.setattr(cpu_vec_isa.VecISA, "_VecISA__bool__impl", tried)
    cpu_vec_isa.valid_vec_isa_list.cache_clear()
    call(graph(), pair())
    assert len(compiled_anew) == 1


def test_only_settings_that_are_known_are_kept():
    class Foreign(GridConfig):
        pass

    @dataclasses.dataclass(frozen=True)
    class Own:
        number: int = 1

    cfg = small_config()
    assert describe(cfg) == describe(small_config()) != describe(small_config(drift=None))
    assert describe((1, None, torch.float32, torch.device("cpu"))) is not None
    assert describe(Foreign()) is describe(Own()) is describe(add_up) is describe((1, Own())) is None
    assert graph(Own())._path((2, torch.float32, torch.device("cpu"))) is None


def test_empty_libraries_of_killed_compilations_are_removed(tmp_path):
    for name, content, age in (("old", b"", 1000), ("new", b"", 0), ("whole", b"ELF", 1000)):
        path = tmp_path / "ab" / f"{name}.so"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
        os.utime(path, (time.time() - age,) * 2)
    remove_unfinished(tmp_path)
    assert sorted(path.stem for path in tmp_path.rglob("*.so")) == ["new", "whole"]


@pytest.mark.slow(10)
def test_another_process_compiles_what_this_one_waits_for(compiled_anew, tmp_path):
    call(graph(), pair())
    (path,) = tmp_path.glob("torchelev/*.graph")
    data = path.read_bytes()
    path.unlink()
    kept = graph()
    kept.helper = run_elsewhere(os.write, 1, b"")  # it writes nothing, and ends
    call(kept, pair())
    assert len(compiled_anew) == 2
    path.unlink()
    kept = graph()
    kept.helper = run_elsewhere(type(path).write_bytes, path, data)
    call(kept, pair())
    assert len(compiled_anew) == 2


def test_what_cannot_be_sent_runs_nowhere():
    assert run_elsewhere(lambda: None) is None
