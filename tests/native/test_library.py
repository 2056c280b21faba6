"""The C++ libraries: built once, kept, and done without where they cannot be built."""

import os
import stat

import pytest

from torchelev.native import library


@pytest.fixture(autouse=True)
def _fresh(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHELEV_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("TORCHELEV_NATIVE", raising=False)
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(library, "_SOURCES", tmp_path)
    library._load.cache_clear()
    yield
    library._load.cache_clear()


needs_compiler = pytest.mark.skipif(library.find_compiler() is None, reason="needs a C++ compiler")


@needs_compiler
def test_a_library_is_built_once_and_again_when_its_source_or_a_constant_changes(tmp_path):
    def answer(value):
        library._load.cache_clear()
        built = library.load("answer.cpp", {"VALUE": str(value)})
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
    with pytest.warns(
        RuntimeWarning, match=r"(?s)broken.cpp could not be built.*CXX.*TORCHELEV_CACHE.*TORCHELEV_NATIVE=0"
    ):
        assert library.load("broken.cpp", {}) is None


@needs_compiler
@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_cache_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache").chmod(stat.S_IRUSR | stat.S_IXUSR)
    (tmp_path / "answer.cpp").write_text('extern "C" int answer() { return 1; }')
    with pytest.warns(RuntimeWarning, match="could not be built"):
        assert library.load("answer.cpp", {}) is None


def test_without_a_compiler_nothing_is_built(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert library.find_compiler() is None
    assert library.load("answer.cpp", {}) is None


def test_it_can_be_switched_off(monkeypatch, tmp_path):
    (tmp_path / "answer.cpp").write_text('extern "C" int answer() { return 1; }')
    monkeypatch.setenv("TORCHELEV_NATIVE", "0")
    assert library.load("answer.cpp", {}) is None and not (tmp_path / "cache").exists()
