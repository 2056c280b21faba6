"""Sites in an S3-compatible object store: moto's server on this machine, with several writers and lost connections."""

import threading

import pytest

pytest.importorskip("icechunk", reason="needs Python 3.11")
pytest.importorskip("moto", reason="needs moto[server]")

from tests.site.helpers import fill, known_cells, robots
from tests.site.object_store import Network, free_port, lead_to, serve
from torchelev.site import SiteMap
from torchelev.site.storage.interface import Overtaken
from torchelev.site.storage.versioned.repository import StoreError, UncertainCommitError

CORNERS = [(0, 0), (70, 0), (0, 70), (200, -90)]
COMMIT = "ref.json"  # whose change is the commit, in Icechunk 1; a repository of Icechunk 2 has `repo`


@pytest.fixture(scope="module")
def server():
    with serve() as port:
        yield port


@pytest.fixture
def url(server, monkeypatch, request):
    """The place of a new site."""
    lead_to(monkeypatch, server)
    return f"s3://bucket/{request.node.name}"


def everything(site):
    return {layer: known_cells(site, layer) for layer in ("elevation", "variance", "other_elevation")}


@pytest.mark.slow(3)
def test_a_site_in_an_object_store_is_the_one_in_memory(url):
    emap, in_memory = robots(CORNERS, noise=0.005), SiteMap(0.1)
    with SiteMap(0.1, url) as site:
        for step in range(2):
            fill(emap, [(x + 10 * step, y) for x, y in CORNERS])
            emap.state.elapsed.add_(10**9)
            for each in (site, in_memory):
                each.merge(emap)
        first = site.versions()[1]
        site.tag("first", first.id)
        assert everything(site) == everything(in_memory) and site.num_bytes > 1000
    reader = SiteMap.open(url, read_only=True)
    assert everything(reader) == everything(in_memory) and reader.time == in_memory.time
    assert len(known_cells(SiteMap.open(url, "first"))) < len(known_cells(reader))
    site = SiteMap.open(url)
    site.rollback("first")
    reader.refresh()
    assert everything(reader) == everything(SiteMap.open(url, "first"))
    assert site.compact(1) >= 0 and {each.tags for each in site.versions()} == {(), ("first",), ("before-rollback-1",)}


@pytest.mark.slow(2)
def test_two_writers_of_other_tiles_commit_on_top_of_each_other(url):
    one, other = SiteMap(0.1, url), SiteMap(0.1, url)
    first, second = robots([(0, 0)]), robots([(300, 0)])
    one.merge(robots([(150, 0)]), time=5.0)
    overtake(other, lambda: one.merge(first, time=7.0))
    times = count_fusions(other)
    other.merge(second, time=6.0)
    one.refresh()
    assert everything(other) == everything(one) and len(known_cells(one)) == 3 * 40 * 36 and len(times) == 1
    assert one.time == other.time == pytest.approx(7.0) and len(one.versions()) == 4


def count_fusions(site):
    fuse, times = site._fuse, []
    site._fuse = lambda *args: (times.append(1), fuse(*args))[1]
    return times


@pytest.mark.slow(2)
def test_two_writers_of_the_same_tile_merge_again_and_nothing_is_lost(url):
    one, other = SiteMap(0.1, url), SiteMap(0.1, url)
    first, second = robots([(0, 0)]), robots([(10, 0)])
    one.merge(robots([(150, 0)]), time=5.0)
    overtake(other, lambda: one.merge(first, time=6.0, align=False))
    times = count_fusions(other)
    other.merge(second, time=7.0, align=False)
    expected, both = SiteMap(0.1), [robots([corner]) for corner in ((150, 0), (0, 0), (10, 0))]
    for time, emap in zip((5.0, 6.0, 7.0), both, strict=True):
        expected.merge(emap, time=time, align=False)
    one.refresh()
    assert everything(other) == everything(one) == everything(expected)
    assert not other.merge(second, time=8.0).new_cells.any() and len(times) == 3


def overtake(site, act):
    """Let another writer act while a site merges for the first time, before it commits."""
    write, times = site._write, []

    def write_late(parts, *args, **options):
        def late():
            yield from parts
            if not times:
                times.append(1)
                act()

        return write(late(), *args, **options)

    site._write = write_late


@pytest.mark.slow(5)
def test_writers_at_once_lose_nothing(url):
    SiteMap(0.1, url).merge(robots([(500, 0)]), time=0.5)
    sites = [SiteMap.open(url) for _ in range(3)]
    failures = []

    def work(number, site):
        try:
            for step in range(5):
                site.merge(robots([(60 * step, 90 * number), (0, 0)]), time=9.0, align=False)
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=each) for each in enumerate(sites)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert not failures
    site = SiteMap.open(url, read_only=True)
    assert len(site.versions()) == 17
    variance = known_cells(site, "variance")
    assert variance[5, 5] == pytest.approx(1e-4 / 16, rel=0.05)  # 15 robots saw it, and one of each three stood there
    assert {(60 * step + 1, 90 * number + 1) for step in range(5) for number in range(3)} <= variance.keys()


@pytest.mark.slow(1)
@pytest.mark.parametrize("answers", [1, None])
def test_a_commit_whose_answer_is_lost_counts_once(url, server, monkeypatch, answers):
    emap = robots(CORNERS[:1])
    SiteMap(0.1, url).merge(robots(CORNERS[1:2]), time=1.0)
    network = Network(server, None)
    lead_to(monkeypatch, network.server_port)
    site = SiteMap.open(url)
    network.lose_at, network.answers = COMMIT, answers
    if answers is None:
        with pytest.raises(
            UncertainCommitError, match="cannot be used.*whether the commit is stored shows at the next merge"
        ):
            site.merge(emap, time=2.0)
        network.is_down, network.lose_at = False, None
    else:
        assert site.merge(emap, time=2.0).new_cells.all()
    assert not site.merge(emap, time=3.0).new_cells.any()
    assert network.lost >= 1 and min(known_cells(site, "variance").values()) > 0.9e-4
    assert len(known_cells(site)) == 2 * 40 * 36


@pytest.mark.slow(1)
def test_a_network_that_ends_before_the_commit_changes_nothing(url, server, monkeypatch):
    SiteMap(0.1, url).merge(robots(CORNERS[1:2]), time=1.0)
    network = Network(server, None)
    lead_to(monkeypatch, network.server_port)
    site, emap = SiteMap.open(url), robots(CORNERS[:1])
    before = everything(site)
    network.lose_at = "snapshots"  # which are written before the commit
    with pytest.raises(OSError, match="cannot be used"):
        site.merge(emap, time=2.0)
    network.is_down, network.lose_at = False, None
    assert everything(SiteMap.open(url)) == before and len(site.versions()) == 2
    assert site.merge(emap, time=3.0).new_cells.all()


@pytest.mark.slow(10)
def test_what_cannot_be_reached_says_why(url, server, monkeypatch):
    with pytest.raises(StoreError, match=r"s3://none/site: cannot be used \(the bucket does not exist\)"):
        SiteMap(0.1, "s3://none/site")
    with pytest.raises(FileNotFoundError, match=r"bucket/nothing: must be a site, got nothing there"):
        SiteMap.open("s3://bucket/nothing")
    with pytest.raises(
        ValueError, match="path: must name a place in the bucket, got s3://bucket/; give s3://bucket/site"
    ):
        SiteMap(0.1, "s3://bucket")
    with pytest.raises(ValueError, match="engine: must be 'icechunk' in an object store, got files"):
        SiteMap(0.1, url, engine="files")
    lead_to(monkeypatch, free_port())
    with pytest.raises(StoreError, match="the server does not answer.*check the network and AWS_ENDPOINT_URL"):
        SiteMap.open(url)


def test_overtaken_groups_say_so(tmp_path, monkeypatch):
    site = SiteMap(0.1, tmp_path / "site")
    site._ranks.size = 2

    def overtaken(*args):
        raise Overtaken

    monkeypatch.setattr(site, "_merge", overtaken)
    with pytest.raises(OSError, match="site: must have no other writer beside a group"):
        site.merge(robots(CORNERS[:1]))
