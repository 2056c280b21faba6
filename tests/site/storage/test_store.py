"""A site's tiles on disk: what is written is read, also by zarr; kills, full disks and readers beside a writer."""

import errno
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("tensorstore", reason="needs torchelev[site]")

from tests.helpers import without
from torchelev.site.storage import transaction, zarr_files
from torchelev.site.storage.store import TileStore

ROOT = Path(__file__).parents[2]
LAYERS, T = ("elevation", "variance"), 8
TILES = [(0, 0), (-1, 0), (2, -3), (5, 5), (-130000, 130000)]


def create(path, tile_size=T, **attributes):
    return TileStore.create(path, layers=LAYERS, tile_size=tile_size, attributes={"resolution": 0.1, **attributes})


def noise(tiles, seed=0):
    values = np.random.default_rng(seed).normal(size=(len(tiles), len(LAYERS), T, T)).astype(np.float32)
    values[:, 1, ::2] = np.nan
    return values


def numbered(number, tiles=TILES):
    """Tiles of which all cells hold the number of their commit."""
    return np.full((len(tiles), len(LAYERS), T, T), number, np.float32)


def commit_number(store, number, tiles=TILES):
    keyframe = np.full((number % 3 + 1, 2), number)
    store.commit(tiles, numbered(number, tiles), {"number": number}, {"keyframes/last": (keyframe, {"number": number})})


def numbers_in(store, tiles=TILES):
    """All numbers of commits that a site holds, in its tiles, its attributes and its array."""
    array, attributes = store.read_array("keyframes/last")
    return {*store.read(tiles).flat, *array.flat, attributes["number"], store.attributes["number"]}


@pytest.fixture
def store(tmp_path):
    with create(tmp_path / "site") as opened:
        yield opened


def files_in(path):
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_what_is_committed_is_read_by_this_store_and_the_next(store):
    values = noise(TILES)
    store.commit(TILES, values, {"resolution": 0.1, "clock": 7})
    store.commit(TILES[1:2], 2 * values[1:2], {"clock": 8, "nested": {"names": ["a"]}})
    values[1] *= 2
    store.close()
    for opened in (store, TileStore.open(store.path), TileStore.open(store.path, read_only=True)):
        np.testing.assert_array_equal(opened.read(TILES), values)
        np.testing.assert_array_equal(opened.read(np.array(TILES[::-1])), values[::-1])
        assert opened.tiles == set(TILES)
        assert opened.attributes == {"clock": 8, "nested": {"names": ["a"]}}
        assert (opened.layers, opened.tile_size) == (LAYERS, T)


def test_tiles_that_are_not_stored_are_nan(store):
    store.commit([(0, 0)], noise([0]), {})
    read = store.read([(0, 0), (0, 1), (1, 0)])
    assert np.isfinite(read[0]).any() and np.isnan(read[1:]).all()
    assert store.read([]).shape == (0, len(LAYERS), T, T)


def test_a_tile_without_known_cells_replaces_an_older_one(store):
    store.commit([(0, 0)], noise([0]), {})
    store.commit([(0, 0)], np.full((1, len(LAYERS), T, T), np.nan), {})
    assert np.isnan(store.read([(0, 0)])).all()


def test_zarr_reads_cells_attributes_and_arrays_without_torchelev(store):
    zarr = pytest.importorskip("zarr", minversion="3", reason="needs Python 3.11")
    values, points = noise(TILES), np.arange(12, dtype=np.int16).reshape(3, 4)
    store.commit(TILES, values, {"resolution": 0.1, "clock": 7}, {"keyframes/0001": (points, {"time": 1.5})})
    group = zarr.open_group(store.path, mode="r")
    attributes, cells = dict(group.attrs), group["cells"]
    assert attributes["format"] == "torchelev site" and attributes["version"] == 1
    assert (attributes["resolution"], attributes["clock"]) == (0.1, 7)
    assert attributes["layers"] == list(LAYERS) and "metres" in attributes["rule"]
    assert cells.metadata.dimension_names == ("layer", "x", "y") and np.isnan(cells.fill_value)
    for (a, b), value in zip(TILES, values, strict=True):
        x, y = attributes["origin"] + a * T, attributes["origin"] + b * T
        np.testing.assert_array_equal(cells[:, x : x + T, y : y + T], value)
    np.testing.assert_array_equal(group["keyframes"]["0001"][:], points)
    assert dict(group["keyframes/0001"].attrs) == {"time": 1.5}


@pytest.mark.parametrize("dtype", ["bool", "uint8", "int64", "float16", "float32", ">f8"])
@pytest.mark.parametrize("shape", [(), (0, 3), (4,), (2, 3, 5)])
def test_arrays_keep_shape_type_and_attributes(store, dtype, shape):
    array = np.random.default_rng(0).integers(0, 2, shape).astype(dtype)
    store.commit([], noise([]), {}, {"keyframes/1": (array.T, {"pose": [1, 2]}), "b": (array, {})})
    read, attributes = store.read_array("keyframes/1")
    np.testing.assert_array_equal(read, array.T)
    assert read.dtype == array.dtype.newbyteorder("=") and attributes == {"pose": [1, 2]}
    assert store.array_names() == ["b", "keyframes/1"]


def test_an_array_may_change_its_shape(store):
    for size in (3, 5, 0):
        store.commit([], noise([]), {}, {"a": (np.arange(size), {"size": size})})
        array, attributes = store.read_array("a")
        assert list(array) == list(range(size)) and attributes == {"size": size}


@pytest.mark.parametrize("name", ["", "cells", "cells/a", "c", "a/c", ".staged", "a/../b", "/a", "a/", "zarr.json"])
def test_arrays_cannot_take_names_that_the_site_needs(store, name):
    with pytest.raises(ValueError, match="arrays: must be named"):
        store.commit([], noise([]), {}, {name: (np.zeros(1), {})})


@pytest.mark.parametrize("names", [("a", "a/b"), ("a/b", "a"), ("a/b/c1", "a/b")])
def test_an_array_has_no_arrays_below_it(store, names):
    store.commit([], noise([]), {}, {names[0]: (np.zeros(1), {})})
    with pytest.raises(ValueError, match="arrays: must not"):
        store.commit([], noise([]), {}, {names[1]: (np.zeros(1), {})})


def test_arrays_that_are_not_there_or_not_numbers(store):
    for name in ("cells", "a", "..", "a/b"):
        with pytest.raises(KeyError, match="must be that of an array"):
            store.read_array(name)
    with pytest.raises(ValueError, match="arrays: must hold bools or numbers, got str"):
        store.commit([], noise([]), {}, {"a": (np.array(["x"]), {})})
    assert store.array_names() == []


WRITER = """
import sys
from tests.site.storage.test_store import TILES, TileStore, commit_number
store = TileStore.open(sys.argv[1])
number = store.attributes["number"]
while True:
    number += 1
    commit_number(store, number)
    print(number, flush=True)
"""


def start_writer(path):
    """Start a process that commits without a pause, and wait for its first commit."""
    writer = subprocess.Popen([sys.executable, "-c", WRITER, path], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert int(writer.stdout.readline()) > 0
    return writer


KILLS = """
import os, random, signal, sys, time
from tests.site.storage.test_store import TileStore, check_after_kill, commit_number

def commit_for_ever(path, pipe):
    store = TileStore.open(path)
    for number in range(store.attributes["number"] + 1, sys.maxsize):
        commit_number(store, number)
        os.write(pipe, b"%d " % number)

def fork(function, *arguments):
    process = os.fork()
    if not process:
        try:
            function(*arguments)
            os._exit(0)
        except BaseException as error:
            print(repr(error), flush=True)
            os._exit(1)
    return process

chance = random.Random(0)
for _ in range(12):
    pipe, end = os.pipe()
    writer = fork(commit_for_ever, sys.argv[1], end)
    os.close(end)
    finished = os.read(pipe, 1000)
    time.sleep(chance.uniform(0, 0.03))
    os.kill(writer, signal.SIGKILL)
    os.waitpid(writer, 0)
    while more := os.read(pipe, 1000):
        finished += more
    os.close(pipe)
    checker = fork(check_after_kill, sys.argv[1], int(finished.split()[-1]))
    assert os.waitpid(checker, 0)[1] == 0
"""


def check_after_kill(path, last):
    """Check that a site is that of the last finished commit, or of the next one; as a reader and as a writer."""
    killed = TileStore.open(path, read_only=True)
    numbers = numbers_in(killed)
    assert numbers in ({last}, {last + 1}), f"{numbers} after {last}"
    with TileStore.open(path) as reopened:
        assert numbers_in(reopened) == numbers
        assert reopened.tiles == killed.tiles == set(TILES)
    assert not {".staged", ".committed"} & set(os.listdir(path))


@pytest.mark.slow(4)
def test_a_kill_loses_at_most_the_commit_in_flight(tmp_path):
    with create(tmp_path / "site") as store:
        commit_number(store, 0)
    # Each round forks from one process that has imported all, before tensorstore starts its threads.
    kills = subprocess.run([sys.executable, "-c", KILLS, store.path], cwd=ROOT, capture_output=True, text=True)
    assert kills.returncode == 0, kills.stdout + kills.stderr


@pytest.mark.slow(3)
def test_readers_beside_a_writer_see_whole_tiles_that_never_get_older(tmp_path):
    with create(tmp_path / "site") as store:
        commit_number(store, 0)
    reader, writer = TileStore.open(store.path, read_only=True), start_writer(store.path)
    try:
        seen, end = [np.zeros(len(TILES))], time.monotonic() + 1
        while time.monotonic() < end:
            values = reader.read(TILES).reshape(len(TILES), -1)
            assert (values == values[:, :1]).all(), "a tile of two commits"
            assert (values[:, 0] >= seen[-1]).all(), "an older or a missing tile"
            array, attributes = reader.read_array("keyframes/last")
            assert {*array.flat} == {attributes["number"]} and len(array) == attributes["number"] % 3 + 1
            reader.refresh()
            assert reader.tiles == set(TILES) and reader.array_names() == ["keyframes/last"]
            seen.append(values[:, 0])
    finally:
        writer.kill()
        writer.communicate()
    assert len({*np.array(seen)[:, 0]}) > 2, "saw no new commits"


@pytest.mark.slow(1)
def test_threads_read_while_one_commits(store):
    commit_number(store, 0)
    failures, done = [], threading.Event()

    def read():
        while not done.is_set():
            values = store.read(TILES).reshape(len(TILES), -1)
            failures.extend(values[(values != values[:, :1]).any(1)])

    reader = threading.Thread(target=read)
    reader.start()
    for number in range(1, 30):
        commit_number(store, number)
    done.set()
    reader.join()
    assert not failures and numbers_in(store) == {29}


class Crash(BaseException):
    """Ends a commit as a kill does: nothing is tidied up."""


@pytest.mark.parametrize("moved", range(10))
def test_a_crash_between_two_moves_is_completed(store, monkeypatch, moved):
    commit_number(store, 1)
    replace, calls = os.replace, []

    def crash(*paths):
        calls.append(paths)
        if len(calls) > moved:
            raise Crash
        replace(*paths)

    monkeypatch.setattr(transaction.os, "replace", crash)
    with pytest.raises(Crash):
        commit_number(store, 2, TILES + [(9, 9)])
    monkeypatch.undo()
    store.close()
    for opened in (TileStore.open(store.path, read_only=True), TileStore.open(store.path)):
        assert numbers_in(opened, TILES + [(9, 9)]) == {2}
        assert opened.tiles == {*TILES, (9, 9)} and opened.array_names() == ["keyframes/last"]
    assert not (store.path / ".committed").exists()


def test_metadata_are_moved_after_what_they_describe(store, monkeypatch):
    commit_number(store, 1)
    replace, moved = os.replace, []
    monkeypatch.setattr(transaction.os, "replace", lambda *paths: (moved.append(Path(paths[1])), replace(*paths)))
    commit_number(store, 2)
    names = [str(path.relative_to(store.path)) for path in moved]
    assert names[-2:] == ["keyframes/last/zarr.json", "zarr.json"] and len(names) == len(TILES) + 3


def test_a_crash_before_the_commit_point_changes_nothing(store, monkeypatch):
    commit_number(store, 1)
    before = files_in(store.path)

    def crash(*paths):
        raise Crash

    monkeypatch.setattr(transaction.os, "rename", crash)
    monkeypatch.setattr(transaction.shutil, "rmtree", lambda path: None)
    with pytest.raises(Crash):
        commit_number(store, 2)
    monkeypatch.undo()
    store.close()
    assert (store.path / ".staged").exists()
    assert numbers_in(TileStore.open(store.path, read_only=True)) == {1}
    with TileStore.open(store.path):
        assert files_in(store.path) == before


def test_moves_that_fail_are_made_up_for_by_the_next_commit(store, monkeypatch):
    commit_number(store, 1)

    def fail(*paths):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(transaction.os, "replace", fail)
    commit_number(store, 2)
    assert numbers_in(store) == {2}
    with pytest.raises(OSError, match="No space left on device"):
        commit_number(store, 3)
    assert numbers_in(store) == {2}
    monkeypatch.undo()
    store.commit([(0, 0)], numbered(4, [0]), {"number": 4})
    assert not (store.path / ".committed").exists()
    assert {*store.read([(0, 0)]).flat} == {4} and {*store.read(TILES[1:]).flat} == {2}


LIMITED = """
import resource, signal, sys
from tests.site.storage.test_store import *
store = TileStore.open(sys.argv[1])
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
tiles = [(a, 7) for a in range(20)]
before = files_in(store.path)
for limit, where, arrays in ((300, tiles, {}), (2000, [], {"a": (np.random.default_rng(0).random(1000), {})})):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    try:
        store.commit(where, noise(where), {}, arrays)
    except OSError as error:
        assert error.errno == errno.EFBIG and "File too large" in str(error), error
    else:
        raise AssertionError("no error")
    assert files_in(store.path) == before
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
store.commit(tiles, noise(tiles), {})
"""


@pytest.mark.slow(3)
def test_writes_that_the_system_refuses_leave_nothing_behind(store):
    commit_number(store, 1)
    store.close()
    done = subprocess.run([sys.executable, "-c", LIMITED, store.path], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    np.testing.assert_array_equal(TileStore.open(store.path).read([(19, 7)]), noise(range(20))[19:])


@pytest.mark.parametrize("text", ["[os_error_code='28']", "[OS error 28: ENOSPC]"])
def test_a_full_disk_is_an_error_that_says_so(text):
    """What a site does then: see test_on_disk."""

    class Refused:
        def exception(self):
            return ValueError(f"RESOURCE_EXHAUSTED: {text}")

    with pytest.raises(OSError, match="No space left on device") as caught:
        zarr_files.wait_for([Refused()])
    assert caught.value.errno == errno.ENOSPC


def test_one_writer_at_a_time(store):
    with pytest.raises(OSError, match=rf"{store.path}: expected one writer.*close the other one, or.*read_only=True"):
        TileStore.open(store.path)
    store.close()
    with TileStore.open(store.path) as second:
        commit_number(second, 1)
        assert numbers_in(store.open(store.path, read_only=True)) == {1}
    with pytest.raises(ValueError, match="must be open for writing, got a store that is read-only or closed"):
        commit_number(second, 2)


def test_reading_only_writes_nothing(store):
    commit_number(store, 1)
    store.close()
    (store.path / ".lock").unlink(missing_ok=True)
    (store.path / ".staged").mkdir()
    before = {str(path) for path in store.path.rglob("*")}
    reader = TileStore.open(store.path, read_only=True)
    assert numbers_in(reader) == {1}
    with pytest.raises(ValueError, match="must be open for writing"):
        commit_number(reader, 2)
    assert {str(path) for path in store.path.rglob("*")} == before


def test_a_folder_that_cannot_be_written(store, monkeypatch):
    commit_number(store, 1)
    store.close()

    def refuse(self, **options):  # root may write to any folder
        raise PermissionError(errno.EACCES, "Permission denied", str(store.path))

    monkeypatch.setattr(transaction.FileLock, "acquire", refuse)
    with pytest.raises(
        PermissionError, match=r"must be writable, got Permission denied; read it with .*read_only=True"
    ):
        TileStore.open(store.path)
    assert numbers_in(TileStore.open(store.path, read_only=True)) == {1}


def test_paths_that_are_no_site(tmp_path):
    file, folder = tmp_path / "file", tmp_path / "folder"
    file.write_text("")
    folder.mkdir()
    (folder / "notes.txt").write_text("")
    for read_only in (False, True):
        with pytest.raises(FileNotFoundError, match="nowhere: must be a folder, got a path where nothing is"):
            TileStore.open(tmp_path / "nowhere", read_only=read_only)
        with pytest.raises(ValueError, match="file: must be a folder, got a file"):
            TileStore.open(file, read_only=read_only)
        with pytest.raises(ValueError, match="folder: must be a site, got a folder without zarr.json"):
            TileStore.open(folder, read_only=read_only)
    with pytest.raises(ValueError, match="file: must be a folder, got a file"):
        create(file)
    with pytest.raises(ValueError, match="folder: must be an empty folder, got one with notes.txt"):
        create(folder)
    with pytest.raises(OSError, match="cannot be written"):
        create(file / "below")
    assert sorted(os.listdir(folder)) == ["notes.txt"] and file.read_text() == ""


def test_a_site_is_not_made_over_another_one(store):
    store.close()
    with pytest.raises(ValueError, match="must be empty, got a site; open it with SiteMap.open"):
        create(store.path)


def test_making_a_site_goes_on_where_a_killed_process_stopped(tmp_path):
    (tmp_path / ".staged" / "cells").mkdir(parents=True)
    (tmp_path / ".lock").touch()
    with create(tmp_path) as store:
        commit_number(store, 1)
    assert not (tmp_path / ".staged").exists()


def edit(file, **attributes):
    metadata = json.loads(file.read_text())
    metadata["attributes"] |= attributes
    file.write_text(json.dumps(metadata))


@pytest.mark.parametrize("version", [2, 0, "1", None])
def test_other_versions_are_refused(store, version):
    store.close()
    edit(store.path / "zarr.json", version=version)
    for read_only in (False, True):
        with pytest.raises(ValueError, match="version 1 to 1, got .*; read it with a newer torchelev"):
            TileStore.open(store.path, read_only=read_only)


def test_other_formats_are_refused(store):
    store.close()
    edit(store.path / "zarr.json", format="microscope")
    with pytest.raises(ValueError, match="must be a site, got Zarr of another format: microscope"):
        TileStore.open(store.path)


@pytest.mark.parametrize("name", ["zarr.json", "cells/zarr.json"])
@pytest.mark.parametrize("content", ["", "{", "[]", "{}", '{"node_type": "array"}', "\udcff"])
def test_damaged_metadata_name_their_file(store, name, content):
    store.close()
    (store.path / name).write_text(content, errors="surrogateescape")
    with pytest.raises(ValueError, match=rf"{store.path}/{name}: must be readable, got damaged|must be a site"):
        TileStore.open(store.path)
    with pytest.raises(ValueError, match="damaged|must be a site"):  # the lock was released
        TileStore.open(store.path)


@pytest.mark.parametrize(
    "attributes", [{"layers": 3}, {"layers": []}, {"tile_size": 0}, {"tile_size": 16}, {"layers": ["a"]}]
)
def test_headers_that_contradict_the_cells_are_refused(store, attributes):
    store.close()
    edit(store.path / "zarr.json", **attributes)
    with pytest.raises(ValueError, match="zarr.json: must be readable, got damaged data"):
        TileStore.open(store.path)


def test_cells_without_metadata_are_refused(store):
    store.close()
    (store.path / "cells/zarr.json").unlink()
    with pytest.raises(ValueError, match="cells/zarr.json: must be readable, got damaged data"):
        TileStore.open(store.path)


@pytest.mark.parametrize("damage", [lambda data: data[:-9], lambda data: b"", lambda data: flip(data)])
def test_a_damaged_tile_is_named_and_others_are_read(store, damage):
    commit_number(store, 1)
    file = next(file for file in store.path.glob("cells/c/0/*/*") if file.parts[-2:] == ("131071", "131072"))
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(ValueError, match=rf"{file} \(tile \(-1, 0\)\): must be readable, got damaged data"):
        store.read(TILES)
    assert {*store.read([TILES[0], *TILES[2:]]).flat} == {1}
    commit_number(store, 2)
    assert numbers_in(store) == {2}


def flip(data):
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 4]) + data[middle + 1 :]


@pytest.mark.parametrize("damage", [None, lambda data: b"", flip])
def test_a_damaged_array_is_named(store, damage):
    store.commit([], noise([]), {}, {"a": (np.arange(100.0), {})})
    file = store.path / "a/c.0"
    file.write_bytes(damage(file.read_bytes())) if damage else file.unlink()
    with pytest.raises(ValueError, match=rf"{store.path}/a: must be readable, got damaged data"):
        store.read_array("a")


@pytest.mark.parametrize(
    ("tiles", "values", "attributes", "text"),
    [
        ([(0, 0)], noise([0, 1]), {}, r"values: expected \(n, L, T, T\) = \(1, 2, 8, 8\), got \(2, 2, 8, 8\)"),
        ([(0, 0), (0, 0)], noise([0, 1]), {}, "tiles: must differ"),
        ([(0.5, 0)], noise([0]), {}, "tiles: expected n pairs of ints"),
        ([(0, 0, 0)], noise([0]), {}, "tiles: expected n pairs of ints"),
        (
            [(2**17, 0)],
            noise([0]),
            {},
            "tiles: must be from -131072 to 131071, counted from the map frame's origin, got 0 to 131072",
        ),
        ([(0, 0)], noise([0]), {"a": float("nan")}, "attributes: must be JSON"),
        ([(0, 0)], noise([0]), {"a": np.float32(1)}, "attributes: must be JSON"),
        ([(0, 0)], noise([0]), {"version": 1}, "attributes: must not be named"),
    ],
)
def test_arguments_that_break_a_rule_change_nothing(store, tiles, values, attributes, text):
    before = files_in(store.path)
    with pytest.raises(ValueError, match=text):
        store.commit(tiles, values, attributes)
    assert files_in(store.path) == before
    commit_number(store, 1)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"layers": ()}, "layers: must be names"),
        ({"layers": "elevation"}, "layers: must be names"),
        ({"layers": ("a", "a")}, "layers: must differ"),
        ({"tile_size": 0}, "tile_size: must be a positive int"),
        ({"attributes": {"layers": 1}}, "attributes: must not be named"),
        ({"attributes": {"a": {1, 2}}}, "attributes: must be JSON"),
    ],
)
def test_sites_that_cannot_be_made_leave_nothing_behind(tmp_path, options, text):
    with pytest.raises(ValueError, match=text):
        TileStore.create(tmp_path / "site", **{"layers": LAYERS, "attributes": {}, **options})
    assert not list(tmp_path.iterdir())


def test_bytes_on_disk_are_those_of_all_files(store):
    commit_number(store, 1)
    assert store.num_bytes == sum(len(data) for data in files_in(store.path).values())


def test_the_folder_may_be_relative_and_the_working_folder_change(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with create("site") as store:
        monkeypatch.chdir("/")
        commit_number(store, 1)
    assert numbers_in(TileStore.open(tmp_path / "site")) == {1}


def test_tensorstore_is_asked_for(tmp_path, monkeypatch):
    without(monkeypatch, "tensorstore")
    with pytest.raises(ModuleNotFoundError, match=r'pip install "torchelev\[site\]"'):
        create(tmp_path / "site")
    assert not list(tmp_path.iterdir())
