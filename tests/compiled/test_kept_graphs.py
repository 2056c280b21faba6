"""Compiled graphs on disk: loaded where they fit, compiled anew where they do not."""

import dataclasses
import os
import pickle
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from filelock import FileLock
from torch._inductor import cpu_vec_isa

from tests.helpers import scan, small_config, small_map
from torchelev import Capsule, GridConfig, LearnedTraversabilityConfig, RobotBody, SensorConfig
from torchelev.compiled import kept_graphs, update
from torchelev.compiled.elsewhere import run_elsewhere
from torchelev.compiled.kept_graphs import Dynamic, KeptGraph, describe, remove_unfinished

pytestmark = [
    pytest.mark.compiles,
    pytest.mark.skipif(not kept_graphs.can_keep(torch.device("cpu")), reason="this torch keeps no graphs"),
]


def scaled(pair, factor):
    return pair[0] * factor + 1


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
    return KeptGraph(scaled, settings, lambda pair, _: Dynamic(1, pair))


def pair(num_envs=2, number=5, dtype=torch.float32):
    return (torch.arange(num_envs * number, dtype=dtype).view(num_envs, number),)


def call(kept, values, factor=2.0):
    assert torch.equal(kept(values, torch.tensor(factor)), scaled(values, factor))


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
        found = kept.prepare(pair(num_envs), torch.tensor(2.0))
        call(kept, pair(num_envs, 9))
        assert found.guard_check(pair(num_envs, 9), torch.tensor(2.0))
        assert not found.guard_check(pair(num_envs + 1, 9), torch.tensor(2.0))


@pytest.mark.slow(10)
def test_what_the_file_does_not_fit_is_compiled_by_the_process(compiled_anew):
    kept = graph()
    call(kept, pair())
    apart = (pair(4)[0].view(2, 10)[:, ::2],)  # of other strides
    assert not kept.prepare(apart, torch.tensor(2.0)).guard_check(apart, torch.tensor(2.0))
    call(kept, apart)
    assert len(compiled_anew) == 1
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(threads + 1)
        call(kept, pair())
    finally:
        torch.set_num_threads(threads)
    assert len(compiled_anew) == 2, "another number of threads has a file of its own"


PATH = """
import torch
from tests.compiled.test_kept_graphs import graph, pair
torch.set_num_threads(1)
print(graph().path(pair(), torch.tensor(2.0)))
"""


@pytest.mark.slow(10)
def test_the_file_depends_neither_on_the_folder_nor_on_the_cores(tmp_path):
    first = sorted(os.sched_getaffinity(0))[0]
    places = (tmp_path, lambda: None), (Path.cwd(), lambda: os.sched_setaffinity(0, {first}))
    environment = os.environ | {"PYTHONPATH": str(Path.cwd()), "TORCHINDUCTOR_CACHE_DIR": str(tmp_path)}
    found = [
        subprocess.run(
            [sys.executable, "-c", PATH], cwd=cwd, preexec_fn=bind, env=environment, capture_output=True, check=True
        ).stdout
        for cwd, bind in places
    ]
    assert found[0] == found[1] and b".graph" in found[0]


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
@pytest.mark.parametrize("obstacle", ["folder", "caches", "compiler"])
def test_what_cannot_be_kept_is_told_and_the_update_runs(compiled_anew, tmp_path, monkeypatch, obstacle):
    if obstacle == "folder":
        (tmp_path / "torchelev").write_text("a file, not a folder")
    elif obstacle == "compiler":
        monkeypatch.setattr(kept_graphs, "traced", lambda *_: 1 / 0)
    disabled = torch._inductor.config.patch(force_disable_caches=obstacle == "caches")
    with disabled, pytest.warns(RuntimeWarning, match="TORCHINDUCTOR_CACHE_DIR"):
        call(graph(), pair())


@pytest.mark.slow(10)
def test_every_mode_of_torch_has_its_own_file(compiled_anew):
    call(graph(), pair())
    usual = graph().path(pair(), torch.tensor(2.0))
    torch.use_deterministic_algorithms(True)
    try:
        assert graph().path(pair(), torch.tensor(2.0)) != usual
        call(graph(), pair())
    finally:
        torch.use_deterministic_algorithms(False)
    with torch.inference_mode():
        assert graph().path(pair(), torch.tensor(2.0)) != usual
    with torch._inductor.config.patch("cpp.min_chunk_size", 17):
        assert graph().path(pair(), torch.tensor(2.0)) != usual
    assert graph().path(pair(number=9), torch.tensor(2.0)) == usual
    assert len({graph().path(*args) for args in ((pair(3), torch.ones(())), (pair(), torch.ones(2)))} - {usual}) == 2
    assert len(compiled_anew) == 2


@pytest.mark.slow(10)
def test_the_first_size_does_not_decide(compiled_anew):
    call(graph(), pair(number=3))
    ((_, args),) = compiled_anew
    assert args[0][0].shape == (2, kept_graphs.EXAMPLE // 2)


@pytest.mark.slow(10)
@pytest.mark.parametrize("is_inference", [True, False])
def test_arguments_keep_their_order_in_memory(compiled_anew, is_inference):
    kept = graph()
    with torch.inference_mode(is_inference):
        for number in (5, 8, 70):
            values = (torch.arange(6.0 * number).view(2, 3, number).transpose(1, 2),)
            call(kept, values)
            assert kept.prepare(values, torch.tensor(2.0)).guard_check(values, torch.tensor(2.0))
    assert len(compiled_anew) == 1


@pytest.mark.slow(10)
def test_threads_wait_for_each_other(compiled_anew):
    kept = graph()
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda number: call(kept, pair(number=number)), range(3, 11)))
    assert len(compiled_anew) == 1


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
    assert describe(Foreign()) is describe(Own()) is describe(scaled) is describe((1, Own())) is None
    assert graph(Own()).path(pair(), torch.tensor(2.0)) is None


def test_empty_libraries_of_killed_compilations_are_removed(tmp_path):
    for name, content, age in (("old", b"", 1000), ("new", b"", 0), ("whole", b"ELF", 1000)):
        path = tmp_path / "ab" / f"{name}.so"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
        os.utime(path, (time.time() - age,) * 2)
    remove_unfinished(tmp_path)
    assert sorted(path.stem for path in tmp_path.rglob("*.so")) == ["new", "whole"]


def write_later(seconds, path, data):
    """Write a file while others wait for it."""
    with FileLock(f"{path}.lock"):
        Path(f"{path}.begun").touch()
        time.sleep(seconds)
        Path(path).write_bytes(data)


@pytest.mark.slow(15)
def test_a_process_waits_for_another_that_compiles_the_same(compiled_anew, tmp_path):
    call(graph(), pair())
    (path,) = tmp_path.glob("torchelev/*.graph")
    data = path.read_bytes()
    path.unlink()
    other = run_elsewhere(write_later, 1.0, str(path), data)
    while not Path(f"{path}.begun").exists():
        assert other.poll() is None
        time.sleep(0.01)
    call(graph(), pair())
    assert other.wait() == 0 and len(compiled_anew) == 1


def test_what_cannot_be_sent_runs_nowhere(monkeypatch):
    assert run_elsewhere(lambda: None) is None
    monkeypatch.setattr("sys.executable", "/opt/robot/bin/program")
    assert run_elsewhere(os.getpid) is None


LEG = RobotBody(capsules=(Capsule(link="leg", start=(0.0, 0.0, 0.0), end=(0.0, 0.0, -0.1), radius=0.02),))
KINDS = {
    "base": {},
    "no base": {},
    "variance": {},
    "covariance": {},
    "links": {"sensor": SensorConfig(body=LEG)},
    "head": {"traversability": LearnedTraversabilityConfig()},
}


@pytest.mark.parametrize("sensors", [1, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", KINDS)
def test_another_process_compiles_the_graphs_that_an_update_looks_for(tmp_path, monkeypatch, kind, dtype, sensors):
    """It makes up a measurement, whose tensors must be like the real one's."""
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(update, "run_elsewhere", lambda function, *order: orders.append(order))
    orders, paths = [], []

    def uncompiled(kept, args):
        paths.append(kept.path(*args))
        kept._function(*kept._examples(args))  # which a trace would run
        return SimpleNamespace(guard_check=lambda *_: True, fn=kept._function)

    monkeypatch.setattr(KeptGraph, "_find", uncompiled)
    update.graphs_of.cache_clear()
    emap = small_map(2, dtype=dtype, **KINDS[kind])
    emap.compile()
    cloud, T = scan(0, 2, 60)
    clouds, poses = cloud[:, None].repeat(1, sensors, 1, 1), T[:, None].repeat(1, sensors, 1, 1)
    given = {"variance": clouds[..., 0].abs() + 0.01} if kind == "variance" else {}
    given |= {"T_base_links": T[:, None]} if kind == "links" else {}
    given |= {"pose_covariance": torch.eye(6).repeat(2, sensors, 1, 1)} if kind == "covariance" else {}
    emap.update(clouds, poses, None if kind == "no base" else T, 0.3, **given)
    assert len(paths) == 3 == len(set(paths)) and emap.validity.any()
    update.graphs_of.cache_clear()
    wanted = {"fuse_heights": paths[1], "apply_rays": paths[2]}
    assert orders, "on one core alone there is no other process"
    for part, path in wanted.items():
        order = pickle.loads(pickle.dumps(orders[0][1:]))
        update.compile_part(part, *order)
        assert paths[-1] == path
    update.graphs_of.cache_clear()
