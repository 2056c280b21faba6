"""The C++ libraries: built once, kept, and done without where they cannot be built."""

import ctypes
import os
import platform
import stat
import subprocess
from pathlib import Path

import pytest

from torchelev.kernels import cpu_build as library
from torchelev.kernels.registry import PACKAGE
from torchelev.runtime.generate import headers


@pytest.fixture(autouse=True)
def _fresh(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHELEV_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("TORCHELEV_NATIVE", raising=False)
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "answer.cpp").write_text('extern "C" int answer() { return 1; }')
    library._load.cache_clear()
    yield
    library._load.cache_clear()


def load(source, defines):
    """A library of a source in the test's folder."""
    return library.load(str(Path.cwd() / source), defines)


needs_compiler = pytest.mark.skipif(library.find_compiler() is None, reason="needs a C++ compiler")


@needs_compiler
def test_a_library_is_built_once_and_again_when_its_source_or_a_constant_changes(tmp_path):
    def answer(value):
        library._load.cache_clear()
        built = load("answer.cpp", {"VALUE": str(value)})
        return built.answer(), len(list((tmp_path / "cache").iterdir()))

    (tmp_path / "answer.cpp").write_text('extern "C" int answer() { return VALUE; }')
    assert answer(7) == (7, 1)
    assert answer(7) == (7, 1)
    assert answer(8) == (8, 2)
    (tmp_path / "answer.cpp").write_text('extern "C" int answer() { return -VALUE; }')
    assert answer(8) == (-8, 3)


@needs_compiler
def test_a_compiler_that_fails_is_told_and_done_without(tmp_path):
    (tmp_path / "broken.cpp").write_text("this is not C++")
    with pytest.warns(RuntimeWarning, match=r"(?s)broken could not be built.*CXX.*TORCHELEV_CACHE.*TORCHELEV_NATIVE=0"):
        assert load("broken.cpp", {}) is None


@needs_compiler
@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_cache_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache").chmod(stat.S_IRUSR | stat.S_IXUSR)
    (tmp_path / "answer.cpp").write_text('extern "C" int answer() { return 1; }')
    with pytest.warns(RuntimeWarning, match="could not be built"):
        assert load("answer.cpp", {}) is None


def test_without_a_compiler_nothing_is_built(monkeypatch):
    monkeypatch.setattr(library.shutil, "which", lambda name: None)
    assert library.find_compiler() is None
    assert load("answer.cpp", {}) is None


def test_a_compiler_that_is_not_there_is_told(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler -O1")
    with pytest.warns(RuntimeWarning, match="CXX=no-such-compiler -O1 is no command"):
        assert load("answer.cpp", {}) is None


@needs_compiler
def test_a_compiler_may_have_arguments(monkeypatch, tmp_path):
    (tmp_path / "answer.cpp").write_text('extern "C" int answer() { return VALUE; }')
    monkeypatch.setenv("CXX", " ".join([*library.find_compiler(), "-DVALUE=5"]))
    assert load("answer.cpp", {}).answer() == 5


@needs_compiler
def test_a_damaged_library_is_built_anew(tmp_path):
    (tmp_path / "answer.cpp").write_text('extern "C" int answer() { return 3; }')
    assert load("answer.cpp", {}).answer() == 3
    (built,) = (tmp_path / "cache").iterdir()
    built.unlink()
    built.write_bytes(b"")
    library._load.cache_clear()
    assert load("answer.cpp", {}).answer() == 3


@needs_compiler
def test_a_user_without_a_home_is_told(monkeypatch, tmp_path):
    def no_home():
        raise RuntimeError("Could not determine home directory.")

    (tmp_path / "answer.cpp").write_text('extern "C" int answer() { return 3; }')
    monkeypatch.delenv("TORCHELEV_CACHE")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(library.Path, "home", no_home)
    with pytest.warns(RuntimeWarning, match="Could not determine home directory.*TORCHELEV_CACHE"):
        assert load("answer.cpp", {}) is None


@pytest.mark.slow(1)
@needs_compiler
def test_what_is_thrown_on_a_thread_is_no_crash(tmp_path):
    (tmp_path / "throwing.cpp").write_text(
        """
        #include "kernels/threads.h"
        #include <new>
        extern "C" int throwing(int count, int threads, int failing) {
            auto work = [&](int k) { if (k == failing) throw std::bad_alloc(); };
            return code_of([&] { for_each(count, threads, work); });
        }
        """
    )
    throwing = load("throwing.cpp", {}).throwing
    library.call(throwing, 100, 3, -1)
    for threads in (1, 3):
        with pytest.raises(MemoryError, match="throwing ran out of memory: give it fewer or smaller maps"):
            library.call(throwing, 100, threads, 50)


def test_it_can_be_switched_off(monkeypatch, tmp_path):
    (tmp_path / "answer.cpp").write_text('extern "C" int answer() { return 1; }')
    monkeypatch.setenv("TORCHELEV_NATIVE", "0")
    assert load("answer.cpp", {}) is None and not (tmp_path / "cache").exists()


@pytest.mark.slow(1)
@needs_compiler
@pytest.mark.parametrize("is_of_torch", [True, False])
def test_threads_of_torch_and_its_own_do_all_the_work(is_of_torch, tmp_path):
    program = tmp_path / "count.cpp"
    program.write_text(
        '#include "kernels/threads.h"\n'
        'extern "C" int count(int* times, int number, int threads) {\n'
        "  return code_of([&] { for_each(number, threads, [&](int k) { times[k] += 1; }); });\n"
        "}\n"
    )
    path = tmp_path / "count.so"
    library._build(library.find_compiler(), library._FLAGS, [str(program)], [], path)
    opened = library._open(path) if is_of_torch else ctypes.CDLL(str(path))
    for number, threads in ((0, 2), (1, 2), (1000, 1), (1000, 2), (1000, 3)):
        times = (ctypes.c_int * number)()
        library.call(opened.count, times, number, threads)
        assert list(times) == [1] * number


@pytest.mark.slow(13)
@needs_compiler
@pytest.mark.skipif(platform.machine() != "x86_64", reason="names vectors of x86-64")
@pytest.mark.parametrize("narrow", ["-mno-avx512f", "-mno-avx512f -mno-avx"])
def test_every_source_builds_for_narrower_vectors(narrow, tmp_path):
    """As of other processors; those that work on vectors say so by their own tests."""
    if narrow == "-mno-avx512f" and "avx512f" not in Path("/proc/cpuinfo").read_text():
        pytest.skip("as for this processor")
    for name, text in headers().items():
        (tmp_path / name).write_text(text)
    sources = [path for path in sorted(PACKAGE.rglob("*.cpp")) if path.parent.parent.name != "runtime"]  # no vectors
    flags = [*library._FLAGS, *narrow.split(), f"-I{tmp_path}", f"-I{PACKAGE}"]
    shared = tmp_path / "shared.h"  # what all include is compiled once
    shared.write_text("#include <algorithm>\n#include <cmath>\n#include <thread>\n#include <vector>\n")

    def compile_one(*arguments):
        command = [*library.find_compiler(), *flags, *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, f"{arguments[-1]}: {done.stderr[:2000]}"

    compile_one("-x", "c++-header", "-o", tmp_path / "shared.h.gch", shared)
    for source in sources:
        compile_one("-include", shared, "-fsyntax-only", source)
