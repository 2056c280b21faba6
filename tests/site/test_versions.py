"""The versions of a site: each merge makes one, they are opened, named, gone back to and forgotten."""

import subprocess
import sys

import pytest
import torch

pytest.importorskip("icechunk", reason="needs Python 3.11")


import icechunk

from tests.site.helpers import fill, known_cells, robots
from torchelev.site import SiteConfig, SiteMap, UncertainCommitError

CORNERS = [(0, 0), (70, 0)]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "site"


def everything(site):
    return {layer: known_cells(site, layer) for layer in ("elevation", "variance", "other_elevation")}


def move(emap, step):
    """Let robots see other ground, one second later."""
    fill(emap, [(x + 10 * step, y) for x, y in CORNERS])
    emap.state.elapsed.add_(10**9)
    return emap


def explore(site, emap, steps):
    """Merge so many times; return what the site held after each, and its versions."""
    seen = []
    for step in range(steps):
        site.merge(move(emap, step))
        seen.append((site.version, everything(site), site.time))
    return seen


def test_each_merge_makes_a_version_that_opens(path):
    with SiteMap(0.1, path) as site:
        seen = explore(site, robots(CORNERS), 3)
        versions = site.versions()
    assert [each.id for each in versions[:3]] == [version for version, *_ in seen[::-1]]
    assert versions[2].message == "2 robots, 2,880 new cells" and versions[2].num_cells == 2880
    assert versions[3].message == "new site" and versions[3].num_robots == 0
    for version, content, time in seen:
        old = SiteMap.open(path, version)
        assert everything(old) == content and old.time == time and old.version == version
        with pytest.raises(ValueError, match="must be open for writing, got a read-only site"):
            old.merge(robots(CORNERS))
    emap = robots(CORNERS, known=0.0)
    emap.initialize_from(SiteMap.open(path, seen[0][0]))
    assert emap.state.validity.all()


def test_a_merge_of_nothing_new_makes_no_version(path):
    site, emap = SiteMap(0.1, path), robots(CORNERS)
    site.merge(emap, time=10.0)
    version = site.version
    site.merge(emap, time=20.0)
    assert site.version == version and site.time == 20.0 and len(site.versions()) == 2


def test_a_rollback_brings_back_what_was(path):
    site, emap = SiteMap(0.1, path), robots(CORNERS)
    seen = explore(site, emap, 3)
    site.tag("good", seen[1][0])
    assert site.rollback("good") == "before-rollback-1"
    assert everything(site) == seen[1][1] and site.time == seen[1][2]
    assert everything(SiteMap.open(path, "before-rollback-1")) == seen[2][1]
    late = robots(CORNERS, seed=1)
    with pytest.raises(
        ValueError, match=r"emap: must be reset after a rollback that took back its last merge.*reset\(\)"
    ):
        site.merge(emap)
    assert everything(site) == seen[1][1]
    emap.reset()
    assert site.merge(move(emap, 3)).new_cells.all() and site.merge(late).new_cells.all()
    again = SiteMap.open(path)  # of which a rollback is known, too
    again.rollback(site.versions()[1].id)
    with pytest.raises(ValueError, match="emap: must be reset"):
        site.merge(late)


def test_robots_that_merged_before_the_version_go_on_after_a_rollback(path):
    site, first, second = SiteMap(0.1, path), robots(CORNERS[:1]), robots(CORNERS[1:])
    site.merge(first, time=1.0)
    version = site.version
    site.merge(second, time=2.0)
    site.rollback(version)
    fill(first, CORNERS[:1], std=0.005)
    first.state.elapsed.add_(10**9)
    site.merge(first, time=3.0)
    assert max(known_cells(site, "variance").values()) == pytest.approx(0.25e-4, rel=0.01)  # counted once
    assert len(known_cells(site)) == 40 * 36


def test_keyframes_go_back_too(path):
    site, emap = SiteMap(0.1, path, keyframes=True), robots(CORNERS)
    T = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    site.merge(emap, T_map_base=T)
    before, version = everything(site), site.version
    site.merge(move(emap, 1), T_map_base=T)
    ids, moved = site.keyframes.ids[:1], site.keyframes.T_map_base[:1].clone()
    moved[:, 2, 3] += 0.1
    site.move_keyframes(ids, moved)
    assert site.versions()[0].message == "1 keyframe moved"
    site.rollback(version)
    assert everything(site) == before and len(site.keyframes.ids) == 2
    emap.reset()
    site.merge(move(emap, 1), T_map_base=T)
    assert len(site.keyframes.ids) == 4


def test_a_site_goes_back_to_what_it_was_when_new(path):
    site, emap = SiteMap(0.1, path), robots(CORNERS)
    site.merge(emap, time=100.0)
    site.rollback(site.versions()[-1].id)
    assert len(site) == 0 and site.time == 0.0
    emap.reset()
    again = SiteMap.open(path)
    again.merge(move(emap, 0), time=200.0)
    assert again.time == 200.0 and len(known_cells(again)) == 2 * 40 * 36


@pytest.mark.parametrize("what", ["a merge of nothing", "initialize_from"])
def test_maps_that_a_rollback_took_back_are_refused_whatever_they_did_since(path, what):
    site, emap = SiteMap(0.1, path), robots(CORNERS)
    site.merge(robots([(300, 0)]), time=1.0)
    version = site.version
    site.merge(emap, time=2.0)
    if what == "a merge of nothing":
        site.merge(emap, time=3.0)
    site.rollback(version)
    if what == "initialize_from":
        emap.initialize_from(site)
    with pytest.raises(ValueError, match="emap: must be reset after a rollback"):
        site.merge(emap, time=4.0)


def test_an_error_after_the_commit_does_not_count_twice(path, monkeypatch):
    site, emap = SiteMap(0.1, path), robots(CORNERS)
    site.merge(robots([(300, 0)]), time=1.0)
    repository = site._store._repository

    class Failing:
        def __getattr__(self, name):
            return getattr(repository, name)

        def readonly_session(self, **options):
            raise icechunk.IcechunkError("object store error: dispatch failure")

    site._store._repository = Failing()
    with pytest.raises(UncertainCommitError, match="whether the commit is stored shows at the next merge"):
        site.merge(emap, time=2.0)
    site._store._repository = repository
    assert not site.merge(emap, time=3.0).new_cells.any()
    assert min(known_cells(site, "variance").values()) > 0.9e-4 and len(site.versions()) == 3


def test_a_writer_without_keyframes_does_not_drop_those_of_another(path):
    site = SiteMap(0.1, path, keyframes=True)
    SiteMap.open(path).merge(robots(CORNERS))
    with pytest.raises(ValueError, match="keyframes: must be kept from the first merge on, got a site without; begin"):
        site.merge(robots(CORNERS), T_map_base=torch.eye(4, dtype=torch.float64).repeat(2, 1, 1))


def test_a_site_that_cannot_be_used_does_not_stay_locked(path):
    SiteMap(0.1, path, engine="files").close()
    with pytest.raises((RuntimeError, AssertionError)) as kept:
        SiteMap(0.1, path, device="cuda:77")
    SiteMap(0.1, path).close()
    assert kept


def test_the_engine_of_a_site_stays(path):
    SiteMap(0.1, path).close()
    with pytest.raises(ValueError, match="engine: must be icechunk, that of .*, got files; leave it out"):
        SiteMap(0.1, path, engine="files")


MAKER = """
import sys
from torchelev.site import SiteMap
print("ready", flush=True)
sys.stdin.readline()
print(SiteMap(0.1, sys.argv[1]).version)
"""


def test_processes_that_make_a_site_at_once_share_it(path):
    command = [sys.executable, "-c", MAKER, str(path)]
    makers = [subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    for maker in makers:
        assert maker.stdout.readline() == "ready\n"
    for maker in makers:
        maker.stdin.write("go\n")
        maker.stdin.flush()
    assert {maker.communicate()[0] for maker in makers} == {f"{SiteMap.open(path).version}\n"}


def test_half_a_site_says_so(path):
    icechunk.Repository.create(icechunk.local_filesystem_storage(str(path)))
    with pytest.raises(ValueError, match="must be a whole site, got one whose making was interrupted; remove it"):
        SiteMap(0.1, path)


def test_closed_and_read_only_sites_get_no_tags(path):
    SiteMap(0.1, path).close()
    for site in (SiteMap.open(path, read_only=True), SiteMap.open(path, SiteMap.open(path).version)):
        with pytest.raises(ValueError, match="site: must be open for writing"):
            site.tag("a")


def test_a_robot_that_waits_changes_nothing(path):
    site, emap = SiteMap(0.1, path), robots(CORNERS, known=0.5)
    emap.state.bounded.copy_(~emap.state.validity)
    emap.state.upper_bound.fill_(2.0)
    site.merge(emap, time=1.0)
    version = site.version
    site.merge(emap, time=2.0)
    assert site.version == version and known_cells(site, "upper_bound")
    emap.state.upper_bound.fill_(1.0)
    site.merge(emap, time=3.0)
    assert site.version != version and max(known_cells(site, "upper_bound").values()) == 1.0


def test_history_does_not_grow_without_end(path):
    with SiteMap(0.1, path, cfg=SiteConfig(keep_versions=5)) as site:
        emap, sizes = robots(CORNERS), []
        for step in range(20):
            fill(emap, CORNERS, std=0.01 * 0.9**step)
            emap.state.elapsed.add_(10**9)
            site.merge(emap)
            sizes.append((len(site.versions()), site.num_bytes))
        assert [number for number, _ in sizes] == [2, 3, 4, 5, 5] + 3 * [6, 7, 8, 9, 5]
        assert sizes[19][1] < 1.3 * sizes[9][1]


def test_two_processes_write_to_one_folder(path):
    site, emap = SiteMap(0.1, path), robots(CORNERS[:1])
    site.merge(emap, time=1.0)
    code = f"""
from tests.site.helpers import robots
from torchelev.site import SiteMap
SiteMap(0.1, {str(path)!r}).merge(robots([(10, 0)]), time=2.0, align=False)
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    fill(emap, CORNERS[:1], std=0.005)
    emap.state.elapsed.add_(10**9)
    site.merge(emap, time=3.0, align=False)  # which sees what the other process has merged
    expected, other = SiteMap(0.1), robots(CORNERS[:1])
    expected.merge(other, time=1.0)
    expected.merge(robots([(10, 0)]), time=2.0, align=False)
    fill(other, CORNERS[:1], std=0.005)
    other.state.elapsed.add_(10**9)
    expected.merge(other, time=3.0, align=False)
    assert everything(site) == everything(expected) and len(site.versions()) == 4


def test_sites_of_files_have_one_version(path):
    with SiteMap(0.1, path, engine="files") as site:
        site.merge(robots(CORNERS))
        (version,) = site.versions()
        assert site.version == version.id == "1" and site.compact() == 0
        assert len(known_cells(SiteMap.open(path, "1"))) == 2 * 40 * 36
        for call in (lambda: site.tag("a"), lambda: site.rollback("1")):
            with pytest.raises(
                ValueError, match="must be of a site with versions, got a site of files; torchelev site conv"
            ):
                call()
        with pytest.raises(
            KeyError, match="version: must be there, got '2' of a site of files, which has 1; leave it out"
        ):
            SiteMap.open(path, "2")


def test_sites_in_memory_have_none():
    site = SiteMap(0.1)
    for call in (site.versions, site.compact, lambda: site.tag("a"), lambda: site.rollback("a")):
        with pytest.raises(ValueError, match="must be of a site on disk or in an object store, got one in memory"):
            call()
    assert site.version == "0"


@pytest.mark.parametrize("keep", [0, -1, 1.5])
def test_how_many_versions_to_keep_is_checked(path, keep):
    with pytest.raises((ValueError, TypeError), match="keep_versions"):
        SiteMap(0.1, path, cfg=SiteConfig(keep_versions=keep))
    site = SiteMap(0.1, path)
    with pytest.raises((ValueError, TypeError), match="keep"):
        site.compact(keep)
    site.close()
    for call in (site.compact, lambda: site.rollback(site.version)):
        with pytest.raises(ValueError, match="site: must be open"):
            call()
    assert len(site.versions()) == 1
