"""A site on disk: it continues, it is bounded in memory, and nothing that was merged is lost."""

import errno
import json
import os
import signal
import subprocess
import sys
import time

import pytest
import torch

from tests.helpers import pose, small_map
from tests.site.helpers import fill, known_cells, robots
from torchelev.site import SiteConfig, SiteMap
from torchelev.site.storage import store as store_module
from torchelev.site.storage.engines import ENGINES
from torchelev.site.storage.versioned import chunks
from torchelev.site.storage.versioned import store as versioned_module

pytest.importorskip("tensorstore")
CORNERS = [(0, 0), (70, 0), (0, 70), (200, -90)]


@pytest.fixture(params=ENGINES)
def engine(request):
    if request.param == "icechunk":
        pytest.importorskip("icechunk", reason="needs Python 3.11")
    return request.param


@pytest.fixture
def path(tmp_path):
    return tmp_path / "site"


def icechunk_error(text):
    import icechunk

    return icechunk.IcechunkError(text)


def everything(site):
    return {layer: known_cells(site, layer) for layer in ("elevation", "variance", "other_elevation", "upper_bound")}


def test_a_site_on_disk_is_the_one_in_memory(path, engine):
    emap = robots(CORNERS, noise=0.005)
    in_memory = SiteMap(0.1)
    with SiteMap(0.1, path, engine=engine) as on_disk:
        for site in (in_memory, on_disk):
            site.merge(emap)
        assert everything(on_disk) == everything(in_memory) and on_disk.num_bytes > 0
    assert everything(SiteMap.open(path, read_only=True)) == everything(in_memory)


def test_opening_continues(path, engine):
    emap = robots(CORNERS)
    emap.state.elapsed.add_(5 * 10**9)
    with SiteMap(0.1, path, engine=engine) as site:
        site.merge(emap)
        before = everything(site)
    with SiteMap(0.1, path, engine=engine) as site:
        assert site.time == pytest.approx(5.0)
        site.merge(emap)  # which has measured nothing since
        assert everything(site) == before
        other = robots([(0, 0)])
        site.merge(other)
        assert min(known_cells(site, "variance").values()) == pytest.approx(0.5e-4, rel=0.01)


def test_memory_is_bounded_by_the_cache(path, engine):
    corners = [(300 * k, 0) for k in range(12)]
    cfg = SiteConfig(cache_tiles=4)
    emap, dense = robots(corners[:2]), SiteMap(0.1)
    with SiteMap(0.1, path, engine=engine, cfg=cfg) as site:
        for a, b in zip(corners[::2], corners[1::2], strict=True):
            fill(emap, [a, b])
            emap.state.elapsed.add_(10**9)
            for target in (site, dense):
                target.merge(emap, align=False)
        assert len(site) == len(dense) > 8 >= site._tiles.values.shape[1]
        xy = torch.tensor(corners) * 0.1 + 0.55
        for layer in ("elevation", "variance"):
            values, valid = site.sample(xy, layer)
            assert valid.all() and torch.equal(values, dense.sample(xy, layer)[0])
        assert everything(site) == everything(dense)


def test_readers_beside_a_writer_see_what_was_merged(path, engine):
    emap = robots(CORNERS[:1])
    with SiteMap(0.1, path, engine=engine) as site:
        site.merge(emap)
        reader = SiteMap.open(path, read_only=True)
        fill(emap, CORNERS[1:2])
        emap.state.elapsed.add_(10**9)
        site.merge(emap)
        reader.refresh()
        assert everything(reader) == everything(site) and reader.time == site.time
        with pytest.raises(ValueError, match="site: must be open for writing, got a read-only site"):
            reader.merge(emap)
        if engine == "files":
            with pytest.raises(OSError, match="one writer at a time"):
                SiteMap.open(path)


def test_a_full_disk_loses_nothing_and_the_next_merge_makes_up_for_it(path, engine, monkeypatch):
    emap = robots(CORNERS)
    with SiteMap(0.1, path, engine=engine) as site:
        site.merge(emap)
        before, clock = everything(site), site.time
        fill(emap, [(x + 20, y) for x, y in CORNERS])
        emap.state.elapsed.add_(10**9)

        def refuse(*args):
            error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            raise error if engine == "files" else icechunk_error(f"object store error: {error} (os error 28)")

        with monkeypatch.context() as patch:
            patch.setattr(store_module, "wait_for", refuse)
            patch.setattr(chunks, "put", refuse)
            with pytest.raises(
                OSError, match="(No space left|disk is full).*before (is|are) unchanged.*make room"
            ) as raised:
                site.merge(emap)
            assert raised.value.errno == errno.ENOSPC
        assert everything(site) == before and site.time == clock
        site.merge(emap)
        assert len(known_cells(site)) > len(before["elevation"])
        after = everything(site)
    dense, same = SiteMap(0.1), robots(CORNERS)
    dense.merge(same)
    fill(same, [(x + 20, y) for x, y in CORNERS])
    same.state.elapsed.add_(10**9)
    dense.merge(same)
    assert after == everything(dense)


def test_new_sites_that_were_opened_again_are_told_apart(tmp_path):
    emap, names = robots(CORNERS), ("a", "b")
    for name in names:
        SiteMap(0.1, tmp_path / name).close()
    sites = [SiteMap.open(tmp_path / name) for name in names]
    for site in sites:
        assert int(site.merge(emap).new_cells.sum()) == 4 * 40 * 36
        site.close()


@pytest.mark.parametrize("keyframes", [False, True])
def test_a_merge_that_is_interrupted_after_its_commit_counts_once(path, engine, monkeypatch, keyframes):
    emap = robots(CORNERS[:1])
    T = torch.eye(4, dtype=torch.float64)[None]
    with SiteMap(0.1, path, engine=engine, keyframes=keyframes) as site:
        site.merge(emap, T_map_base=T)
        fill(emap, CORNERS[:1], std=0.005)
        emap.state.elapsed.add_(10**9)

        def interrupt(*args):
            if engine == "icechunk":
                committed(*args)
            raise KeyboardInterrupt

        committed = versioned_module.commit
        with monkeypatch.context() as patch:
            patch.setattr(store_module, "finish", interrupt)
            patch.setattr(versioned_module, "commit", interrupt)
            with pytest.raises(KeyboardInterrupt):
                site.merge(emap, T_map_base=T)
        assert site.time == pytest.approx(1.0)
        assert int(site.merge(emap, T_map_base=T).new_cells) == 0
        assert max(known_cells(site, "variance").values()) == pytest.approx(0.25e-4, rel=0.01)
        if keyframes:
            assert len(site.keyframes.ids) == 3


WRITER = """
import sys, torch
from tests.site.helpers import fill, robots
from torchelev.site import SiteMap

corners = [(0, 0), (30, 10), (64, 64), (-40, 20)]
emap = robots(corners)
with SiteMap(0.1, sys.argv[1], engine=sys.argv[3]) as site:
    for number in range(int(sys.argv[2]) + 1, 10000):
        fill(emap, corners, lambda x, y: 0.0 * x + number)  # one height everywhere, which contradicts the one before
        emap.state.elapsed.add_(10**9)
        site.merge(emap, align=False)
        print(number, flush=True)
"""


@pytest.mark.slow(12)
def test_a_killed_merge_is_there_completely_or_not_at_all(path, engine):
    last = 0
    for delay in (0.0, 0.013, 0.037, 0.061):
        process = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path), str(last), engine],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ},
        )
        for _ in range(3):
            last = int(process.stdout.readline())
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        last = int(([str(last), *process.stdout.read().split()])[-1])
        process.wait()
        with SiteMap.open(path) as site:
            heights = set(known_cells(site).values())
            assert len(heights) == 1 and heights <= {float(last), float(last + 1)}


def test_a_closed_site_says_so_and_can_be_read_on(path, engine, tmp_path):
    emap, poses = robots(CORNERS[:1]), pose()
    site = SiteMap(0.1, path, engine=engine, keyframes=True)
    site.merge(emap, T_map_base=poses)
    before = everything(site)
    reader = SiteMap.open(path, read_only=True)
    with pytest.raises(ValueError, match=r"site: must be open for writing, got a read-only site; open it without"):
        reader.merge(emap, T_map_base=poses)
    for closed in (site, reader):
        closed.close()
        text = r"site: must be open, got a site after close\(\); open it again with SiteMap\(resolution=\.\.\., path="
        with pytest.raises(ValueError, match=text):
            closed.merge(emap, T_map_base=poses)
        with pytest.raises(ValueError, match=text):
            closed.merge(emap)
        with pytest.raises(ValueError, match=text):
            closed.move_keyframes(closed.keyframes.ids, closed.keyframes.T_map_base)
        small_map(1, (40, 36)).initialize_from(closed)
        closed.export(tmp_path / "site.npz")
        closed.refresh()
        assert everything(closed) == before and closed.num_bytes > 0
    with SiteMap(0.1, path, engine=engine) as again:
        again.merge(emap, T_map_base=poses)


def test_bad_paths_and_sites_are_refused_and_left_alone(path, engine, tmp_path):
    emap = robots(CORNERS[:1])
    with SiteMap(0.1, path, engine=engine) as site:
        site.merge(emap)
        before = everything(site)
    with pytest.raises(ValueError, match=r"resolution: must be 0\.1 m, that of .*, got 0\.05"):
        SiteMap(0.05, path)
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(ValueError, match="file"):
        SiteMap(0.1, file)
    hint = r"give the folder of a site; SiteMap\(resolution=\.\.\., path=\.\.\.\) makes one"
    with pytest.raises(FileNotFoundError, match=f"nothing: must be a folder, got a path where nothing is; {hint}"):
        SiteMap.open(tmp_path / "nothing")
    with pytest.raises(ValueError, match=f"must be a site, got a folder without zarr.json; {hint}"):
        SiteMap.open(tmp_path)
    if engine == "icechunk":
        return
    metadata = json.loads((path / "zarr.json").read_text())
    metadata["attributes"]["version"] = 99
    (path / "zarr.json").write_text(json.dumps(metadata))
    with pytest.raises(ValueError, match="version"):
        SiteMap.open(path)
    metadata["attributes"]["version"] = 1
    (path / "zarr.json").write_text(json.dumps(metadata))
    assert file.read_text() == "mine" and everything(SiteMap.open(path)) == before
