"""A site in an Icechunk repository: versions, tags, going back, forgetting, several writers, and what goes wrong."""

import multiprocessing
import threading
from datetime import datetime, timezone

import numpy as np
import pytest

pytest.importorskip("icechunk", reason="needs Python 3.11")

import icechunk

from torchelev.site.storage.engines import create_store, exists, open_store
from torchelev.site.storage.interface import Note, Overtaken
from torchelev.site.storage.versioned import arrays, commits, history, repository
from torchelev.site.storage.versioned.repository import StoreError, UncertainCommitError
from torchelev.site.storage.versioned.store import VersionedStore

LAYERS, T = ("elevation", "variance"), 8
TILES = [(0, 0), (-1, 0), (2, -3), (-130000, 130000)]


def numbered(number, tiles=TILES):
    """Tiles of which all cells hold the number of their commit."""
    return np.full((len(tiles), len(LAYERS), T, T), number, np.float32)


def commit(store, number, tiles=TILES):
    with store.transaction({"number": number}, note=Note(f"commit {number}", number, 10 * number)) as write:
        write(tiles, numbered(number, tiles))
    return store.version


def numbers(store, tiles=TILES):
    return [float(tile[0, 0, 0]) for tile in store.read(tiles)]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "site"


@pytest.fixture
def store(path):
    return create_store(path, layers=LAYERS, tile_size=T, attributes={"resolution": 0.1})


def test_what_is_committed_is_read_by_this_store_and_the_next(store, path):
    values = np.random.default_rng(0).normal(size=numbered(0).shape).astype(np.float32)
    values[:, 1, ::2] = np.nan
    array = np.arange(6, dtype=np.int16).reshape(2, 3)
    attributes = {"z": 1, "a": {"names": ["b"], "at": 1e-9}}
    store.commit(TILES, values, attributes, {"keyframes/0001": (array, {"pose": [1.5]}), "scalar": (np.array(2.5), {})})
    store.close()
    for opened in (store, open_store(path), open_store(path, read_only=True)):
        np.testing.assert_array_equal(opened.read(TILES[::-1]), values[::-1])
        assert opened.tiles == set(TILES) and np.isnan(opened.read([(7, 7)])).all()
        assert opened.attributes == attributes and list(opened.attributes) == ["z", "a"]
        assert (opened.layers, opened.tile_size) == (LAYERS, T)
        stored, own = opened.read_array("keyframes/0001")
        np.testing.assert_array_equal(stored, array)
        assert stored.dtype == array.dtype and own == {"pose": [1.5]} and opened.read_array("scalar")[0] == 2.5
        assert opened.array_names() == ["keyframes/0001", "scalar"] and opened.num_bytes > 1000
        with pytest.raises(KeyError, match="must be that of an array, got 'keyframes/2'"):
            opened.read_array("keyframes/2")


def test_zarr_reads_the_cells_of_any_version(store, path):
    zarr = pytest.importorskip("zarr")
    first = commit(store, 1)
    commit(store, 2)
    opened = icechunk.Repository.open(icechunk.local_filesystem_storage(str(path)))
    for session, number in ((opened.readonly_session("main"), 2), (opened.readonly_session(snapshot_id=first), 1)):
        group = zarr.open_group(session.store, mode="r")
        x = group.attrs["origin"] + 2 * T
        y = group.attrs["origin"] - 3 * T
        assert (group["cells"][:, x : x + T, y : y + T] == number).all()
        assert group["cells"].metadata.dimension_names == ("layer", "x", "y")
        assert group.attrs["format"] == "torchelev site" and group.attrs["layers"] == list(LAYERS)


def test_each_commit_is_a_version_that_stays_readable(store, path):
    ids = [commit(store, number) for number in (1, 2, 3)]
    versions = store.versions()
    assert [each.id for each in versions[:3]] == ids[::-1] and versions[3].message == "new site"
    assert [(each.message, each.num_robots, each.num_cells) for each in versions[:2]] == [
        ("commit 3", 3, 30),
        ("commit 2", 2, 20),
    ]
    assert abs(versions[0].time - datetime.now(timezone.utc)).total_seconds() < 60.0
    for version, number in zip(ids, (1, 2, 3), strict=True):
        old = open_store(path, version=version)
        assert set(numbers(old)) == {number} and old.attributes == {"number": number} and old.is_read_only
        commit(store, 4)
        old.refresh()
        assert old.version == version
        with pytest.raises(ValueError, match="must be open for writing, got a store that is read-only"):
            commit(old, 5)


def test_a_commit_of_nothing_but_time_makes_no_version(store, path):
    store.commit(TILES, numbered(1), {"num_commits": 1, "time": 1.0, "epoch": 5.0})
    version = store.version
    with store.transaction({"num_commits": 2, "time": 2.0, "epoch": 5.0}):
        pass
    assert store.version == version and store.attributes["time"] == 2.0 and len(store.versions()) == 2
    with store.transaction({"num_commits": 3, "time": 2.0, "epoch": 5.0, "notes": "new"}):
        pass
    assert len(store.versions()) == 3 and open_store(path).attributes["notes"] == "new"


def test_tags_name_versions(store, path):
    first, second = commit(store, 1), commit(store, 2)
    store.tag("spring", first)
    store.tag("also", "spring")
    assert [each.tags for each in store.versions()] == [(), ("also", "spring"), ()]
    assert str(store.versions()[1]).endswith("commit 1  [also]  [spring]")
    assert open_store(path, version="spring").version == first
    with pytest.raises(ValueError, match="name: must be new, got 'spring', which names a version"):
        store.tag("spring", second)
    for name in ("", "a b", "-a", "../a", 3):
        with pytest.raises(ValueError, match="name: must be made of letters"):
            store.tag(name, second)
    with pytest.raises(KeyError, match=r"version: must be the id or tag of a version, got 'summer'.*has also, spring"):
        open_store(path, version="summer")


def test_a_rollback_makes_a_new_version_and_keeps_the_one_it_leaves(store, path):
    first, _, third = (commit(store, number) for number in (1, 2, 3))
    reader = open_store(path, read_only=True)
    assert store.rollback(first) == "before-rollback-1"
    reader.refresh()
    for each in (store, reader):
        assert set(numbers(each)) == {1} and each.attributes["number"] == 1
    assert store.versions()[0].message == f"rolled back to {first}"
    assert set(numbers(open_store(path, version="before-rollback-1"))) == {3}
    commit(store, 4)
    assert store.rollback("before-rollback-1") == "before-rollback-2" and set(numbers(store)) == {3}
    assert store.rollback(store.version) == ""
    assert {each.id for each in store.versions()} >= {first, third}


def test_rollbacks_say_which_commits_they_took_back(store):
    ids = []
    for number in range(1, 5):
        store.commit(TILES, numbered(number), {"num_commits": number, "epoch": 0.0, "time": 1.0 * number})
        ids.append(store.version)
    store.rollback(ids[1])
    expected = {"num_commits": 5, "epoch": 0.0, "time": 2.0, "rollbacks": [[2, 5]]}
    assert store.attributes == expected
    store.rollback(ids[0])
    assert store.attributes == expected | {"num_commits": 6, "time": 1.0, "rollbacks": [[2, 5], [1, 6]]}


def test_compacting_keeps_the_newest_versions_and_those_with_tags(store, path):
    ids = [commit(store, number) for number in range(1, 11)]
    store.tag("third", ids[2])
    before = store.num_bytes
    assert store.compact(2) > 0 and store.num_bytes < 0.6 * before
    assert [each.id for each in store.versions()] == [ids[9], ids[8], ids[2]]
    assert set(numbers(open_store(path, version="third"))) == {3} and set(numbers(store)) == {10}
    with pytest.raises(KeyError, match="must be the id or tag"):
        open_store(path, version=ids[5])
    commit(store, 11)
    assert store.compact(100) == 0 and len(store.versions()) == 4
    with pytest.raises(ValueError, match="keep: must be"):
        store.compact(0)


# Several writers -----------------------------------------------------------------------------------------------------


def test_writers_of_a_folder_take_turns(store, path):
    other = open_store(path)
    commit(store, 1)
    with pytest.raises(Overtaken):  # it has not read the newest version
        commit(other, 2)
    with other.turn() as is_behind:
        assert is_behind and set(numbers(other)) == {1}
        done = threading.Event()
        thread = threading.Thread(target=lambda: (commit_in_turn(store, 3), done.set()))
        thread.start()
        assert not done.wait(0.3)
        commit(other, 2)
    thread.join(20)
    assert done.is_set() and [each.message for each in store.versions()[:2]] == ["commit 3", "commit 2"]


def commit_in_turn(store, number, tiles=TILES):
    with store.turn():
        commit(store, number, tiles)


def write_many(path, first):
    store = VersionedStore.open(path)
    for number in range(first, first + 10):
        commit_in_turn(store, number, [(number, 0), (0, 0)])


def test_processes_that_write_at_once_lose_nothing(store, path):
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=write_many, args=(path, first)) for first in (100, 200)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join(60)
    store.refresh()
    expected = [*range(100, 110), *range(200, 210)]
    assert numbers(store, [(number, 0) for number in expected]) == expected
    assert len(store.versions()) == 21 and numbers(store, [(0, 0)])[0] == store.attributes["number"]


def test_a_writer_that_waits_too_long_is_told(store, path, monkeypatch):
    other = open_store(path)
    other._lock.timeout = 0.1
    with store.turn(), pytest.raises(OSError, match="must become free within .* got another writer; wait until it has"):
        commit(other, 1)
    commit(other, 1)


# What goes wrong ------------------------------------------------------------------------------------------------------


def test_a_damaged_chunk_is_named(store, path):
    big = (
        np.random.default_rng(0).normal(size=(1, len(LAYERS), 64, 64)).astype(np.float32)
    )  # small ones lie in manifests
    large = create_store(path.with_name("large"), layers=LAYERS, tile_size=64, attributes={})
    large.commit([(0, 0)], big, {})
    (chunk,) = (path.with_name("large") / "chunks").iterdir()
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    with pytest.raises(ValueError, match=r"cells \(tile \(0, 0\)\): must be readable, got damaged data"):
        open_store(path.with_name("large")).read([(0, 0)])


def test_bad_arguments_change_nothing(store):
    version = commit(store, 1)
    for tiles, values, attributes, further, text in (
        ([(0, 0), (0, 0)], numbered(2, TILES[:2]), {}, {}, "tiles: must differ"),
        ([(0, 0)], numbered(2, TILES[:2]), {}, {}, "values: expected"),
        ([(0, 0)], numbered(2, TILES[:1]), {"layers": 1}, {}, "attributes: must not be named"),
        ([(0, 0)], numbered(2, TILES[:1]), {"number": np.float32(1)}, {}, "attributes: must be JSON"),
        ([(0, 0)], numbered(2, TILES[:1]), {}, {"cells/a": (np.zeros(1), {})}, "arrays: must be named"),
        ([(0, 0)], numbered(2, TILES[:1]), {}, {"a": (np.array(["x"]), {})}, "arrays: must hold bools or numbers"),
    ):
        with pytest.raises(ValueError, match=text):
            store.commit(tiles, values, attributes, further)
    assert store.version == version and set(numbers(store)) == {1}
    store.close()
    with pytest.raises(ValueError, match="must be open for writing"):
        commit(store, 2)


def test_what_is_no_site_is_refused(store, path, tmp_path):
    assert exists(path) and not exists(tmp_path) and not exists(tmp_path / "nothing")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    for engine in ("icechunk", "files"):
        with pytest.raises(ValueError, match="must be an empty folder, got one with notes.txt"):
            create_store(tmp_path / "mine", layers=LAYERS, tile_size=T, attributes={}, engine=engine)
    with pytest.raises(ValueError, match="engine: must be one of icechunk, files, got 'hdf5'"):
        create_store(tmp_path / "new", layers=LAYERS, tile_size=T, attributes={}, engine="hdf5")
    with pytest.raises(FileNotFoundError, match="must be a folder, got a path where nothing is"):
        open_store(tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists() and not (tmp_path / "new").exists()


def test_another_repository_is_no_site(tmp_path):
    import zarr

    path = tmp_path / "weather"
    made = icechunk.Repository.create(icechunk.local_filesystem_storage(str(path)))
    session = made.writable_session("main")
    zarr.create_group(session.store, attributes={"format": "weather"})
    session.commit("weather")
    with pytest.raises(ValueError, match="must be a site, got Zarr of another format: weather"):
        open_store(path)


class Lossy:
    """A session whose answer is lost, after it has committed or before."""

    def __init__(self, session, is_stored):
        self.session, self.is_stored, self.snapshot_id = session, is_stored, session.snapshot_id

    def commit(self, *args, **options):
        if self.is_stored:
            self.session.commit(*args, **options)
        raise icechunk.IcechunkError("object store error: dispatch failure")


@pytest.mark.parametrize("is_stored", [True, False])
def test_a_commit_in_doubt_is_found_again(store, is_stored):
    commit(store, 1)
    session, metadata = store._repository.writable_session("main"), history.metadata_of({}, Note("a"), "key")
    arrays.write_array(session.store, "a", np.zeros(1), {})
    lossy, text = Lossy(session, is_stored), "the server does not answer.*shows at the next merge"
    with pytest.raises(UncertainCommitError, match=text) as raised:
        commits.commit(store._repository, lossy, store.path, store._header, "a", "key", lambda _: metadata)
    assert store.holds(raised.value.commit) == is_stored


@pytest.mark.parametrize(
    ("text", "meaning", "hint"),
    [
        ("NoSuchBucket: The specified bucket does not exist", "the bucket does not exist", "AWS_ENDPOINT_URL"),
        ("service error AccessDenied", "the credentials are refused", "AWS_ACCESS_KEY_ID"),
        ("the credential provider was not enabled", "there are no credentials", "AWS_ACCESS_KEY_ID"),
        ("No space left on device (os error 28)", "the disk is full", "make room"),
        (
            "invalid snapshot timestamp ordering. parent: `2026",
            "the clock of this machine, or .* is wrong",
            "set the clocks",
        ),
        ("snapshot timestamp is invalid, please verify", "the clock of this machine, or .* is wrong", "set the clocks"),
        ("dispatch failure", "the server does not answer", "check the network"),
        ("  x something else\n  | context", "something else", "try again"),
    ],
)
def test_errors_say_what_is_wrong_and_how_to_fix_it(text, meaning, hint):
    with pytest.raises(StoreError, match=f"s3://b/site: cannot be used .{meaning}.; all that was stored.*{hint}"):
        with repository.errors_in_words("s3://b/site"):
            raise icechunk.IcechunkError(text)
