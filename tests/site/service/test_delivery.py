"""Nothing is lost and nothing counts twice, on a network that loses, repeats and reorders."""

import errno
import shutil
import warnings

import numpy as np
import pytest
import torch

from tests.site.helpers import known_cells
from tests.site.service.walks import START, Network, Walker, assert_same
from torchelev.site import SiteMap
from torchelev.site.service.outbox import Outbox
from torchelev.site.service.server.merger import SiteServer


@pytest.fixture(autouse=True)
def times_may_go_back():
    """Direct merges of several robots warn of times that lie before the newest one."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        yield


def test_a_network_without_faults_gives_the_bits_of_direct_merges():
    network = Network([Walker("a")])
    for _ in range(8):
        network.walk()
        network.exchange()
    network.drain()
    assert network.server.counts["merged"] == 8 and not network.server.counts["repeated"]
    for layer in ("elevation", "variance", "upper_bound"):
        assert known_cells(network.server.site, layer) == known_cells(network.direct, layer)


FAULTS = {
    "loss": {"loss": 0.5},
    "repeats": {"repeats": 0.7},
    "disorder": {"disorder": 3.0},
    "all": {"loss": 0.3, "repeats": 0.5, "disorder": 4.0},
}


@pytest.mark.slow(4)
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("faults", FAULTS)
def test_faults_of_the_network_change_nothing(faults, seed):
    walkers = [Walker("a", seed=seed), Walker("b", y=1.0, seed=10 + seed)]
    network = Network(walkers, seed=seed, **FAULTS[faults])
    for k in range(12):
        network.walk(dx=0.4 if k < 8 else -0.5)
        network.exchange()
    network.drain()
    assert_same(network.server.site, network.direct)


@pytest.mark.slow(3)
def test_a_robot_that_was_away_for_an_hour_brings_all_of_it():
    network = Network([Walker("a"), Walker("b", y=2.0, seed=1)])
    network.walk()
    network.exchange()
    network.is_down = True
    for k in range(90):  # it walks, stands, and comes back
        network.walk(dx=(0.5, 0.0, -0.5)[k // 30], dt=40.0)
        network.time += 40.0
    outbox = network.outboxes["a"]
    most, messages = outbox.waiting_bytes, network.num_bytes
    network.is_down = False
    network.drain()
    assert_same(network.server.site, network.direct)
    assert 0 < most < 2e6 and network.num_bytes - messages < 2e6
    assert outbox.num_acknowledged < 25  # of 91 that were published


def test_standing_without_a_connection_keeps_one_snapshot():
    network = Network([Walker("a")])
    network.is_down = True
    for _ in range(20):
        network.walk(dx=0.0)
    assert network.outboxes["a"].waiting_bytes == 0
    network.is_down = False
    network.drain()
    assert network.server.counts["merged"] == 1
    assert_same(network.server.site, network.direct)


def test_what_does_not_fit_is_given_up_with_a_warning_and_counted():
    network = Network([Walker("a")])
    network.walk()
    network.exchange()
    network.is_down, outbox = True, network.outboxes["a"]
    outbox.max_waiting = 200_000
    with pytest.warns(RuntimeWarning, match="cells were given up"):
        for _ in range(60):
            network.walk(dx=0.5)
    assert outbox.waiting_bytes <= 200_000 and outbox.dropped_cells > 1000
    network.is_down = False
    network.drain()
    there, direct = (known_cells(site, "variance") for site in (network.server.site, network.direct))
    lost = direct.keys() - there.keys()
    assert 0 < len(lost) <= outbox.dropped_cells and there.keys() <= direct.keys()
    assert all(value >= direct[cell] - 1e-9 for cell, value in there.items())  # nothing counts twice


@pytest.mark.parametrize("is_down", [False, True])
def test_a_robot_that_was_reset_measures_anew(is_down):
    network = Network([Walker("a")])
    for k in range(6):
        if k == 3:
            network.is_down = is_down
            network.walkers[0].emap.reset()
        network.walk(dx=0.2)
        network.exchange()
    network.is_down = False
    network.drain()
    assert_same(network.server.site, network.direct)


def test_coming_back_to_a_place_without_a_connection_counts_both_visits():
    network = Network([Walker("a")])
    network.walk()
    network.exchange()
    network.is_down = True
    for dx in [0.8] * 6 + [-0.8] * 12 + [0.8] * 6:
        network.walk(dx=dx)
    network.is_down = False
    network.drain()
    assert_same(network.server.site, network.direct)


def test_a_merger_that_ends_between_commit_and_acknowledgement_does_not_count_twice(tmp_path):
    network = Network([Walker("a")], path=tmp_path / "site")
    for _ in range(4):
        network.walk()
        network.server.handle(message_of(network), "a")
        assert network.server.step()  # the answers are lost with the process
        network.server.close()
        network.start()
        network.exchange()
    network.drain()
    assert network.server.counts["merged"] == 0  # of the last process: all was merged by those before
    assert_same(network.server.site, network.direct)
    network.server.close()


def message_of(network):
    """The next windows of the first robot, after it was greeted."""
    outbox, payload = network.outboxes["a"], None
    while payload is None or b'"hello"' in payload:
        network.time += 10.0
        payload = outbox.next_message(network.time)
        if b'"hello"' in payload:
            network.server.handle(payload, "a")
            for answer in network.server.step():
                outbox.receive(answer.payload, network.time)
    return payload


def test_a_commit_that_fails_leaves_the_robot_waiting(tmp_path, monkeypatch):
    network = Network([Walker("a")], path=tmp_path / "site", engine="files")
    network.walk()
    network.exchange()
    with monkeypatch.context() as patch:
        patch.setattr(network.server.site._store, "_prepare", raise_full)
        network.walk()
        network.server.handle(message_of(network), "a")
        with pytest.raises(OSError, match="No space left"):
            network.server.step()
    network.drain()
    assert_same(network.server.site, network.direct)
    network.server.close()


def raise_full(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_two_mergers_of_one_folder_count_a_message_once(tmp_path):
    pytest.importorskip("icechunk")
    network = Network([Walker("a"), Walker("b", y=1.0, seed=1)], path=tmp_path / "site", engine="icechunk")
    network.walk()
    network.exchange()
    other = SiteServer(tmp_path / "site", clock=lambda: START + 1e6, align=False)
    for _ in range(3):
        network.walk()
        payloads = {name: outbox.next_message(network.time + 100.0) for name, outbox in network.outboxes.items()}
        for server in (other, network.server):  # both get what both robots send
            for name, payload in payloads.items():
                server.handle(payload, name)
            assert len(server.step()) >= 2
        network.time += 100.0
        network.drain()
    network.server.site.refresh()
    assert_same(network.server.site, network.direct)
    assert other.counts["merged"] + network.server.counts["merged"] == 2 + 3 * 2


def test_after_a_rollback_a_robot_must_begin_anew(tmp_path):
    pytest.importorskip("icechunk")
    network = Network([Walker("a")], path=tmp_path / "site", engine="icechunk")
    network.walk()
    network.exchange()
    version = network.server.site.version
    network.walk()
    network.exchange()
    with SiteMap.open(tmp_path / "site") as site:  # another process
        site.rollback(version)
    network.walk()
    network.exchange()
    assert "after a rollback" in str(network.outboxes["a"].error)
    walker = network.walkers[0]
    walker.emap.reset()
    network.outboxes["a"] = Outbox("a", 0.1)
    walker.step()
    network.outboxes["a"].add(walker.snapshot())
    network.drain()
    assert network.server.counts["merged"] == 3


def test_merges_of_other_maps_keep_the_notes(tmp_path):
    network, other = Network([Walker("a")], path=tmp_path / "site"), Walker("b", y=3.0)
    network.walk()
    network.server.handle(message_of(network), "a")
    network.server.step()
    network.server.close()
    other.step()
    with SiteMap.open(tmp_path / "site") as site:
        for merged in (site, network.direct):
            merged.merge(other.emap, time=START + 5.0, align=False)
    network.start()
    network.drain()
    assert network.server.counts["repeated"] and not network.server.counts["merged"]
    assert_same(network.server.site, network.direct)
    network.server.close()


def test_a_robot_that_starts_again_takes_over_its_name():
    first, second = Walker("a"), Walker("a", seed=1)
    network = Network([first])
    network.walk()
    late = message_of(network)
    network.exchange(20.0)
    old, network.walkers = network.outboxes["a"], [second]
    network.outboxes["a"] = Outbox("a", 0.1)
    network.walk()
    network.drain()
    for payload in (late, late):  # of the link before
        network.server.handle(payload, "a")
        network.server.step()
    assert_same(network.server.site, network.direct)
    first.step()
    old.add(first.snapshot())
    network.server.handle(old.next_message(network.time + 100.0), "a")
    for answer in network.server.step():
        old.receive(answer.payload, network.time)
    assert "another link has this name" in str(old.error)


def test_two_links_that_greet_at_once_both_count():
    walkers = [Walker("a"), Walker("a", seed=1)]
    network, others = Network(walkers[:1]), Outbox("a", 0.1)
    network.walk()
    walkers[1].step()
    network.direct.merge(walkers[1].emap, time=walkers[1].time, align=False)
    others.add(walkers[1].snapshot())
    boxes = [network.outboxes["a"], others]
    for k in range(8):  # both hear all answers, as they have one name
        for box in boxes:
            payload = box.next_message(10.0 * k)
            if payload is not None:
                network.server.handle(payload, "a")
        for answer in network.server.step():
            for box in boxes:
                box.receive(answer.payload, 10.0 * k)
    assert others.is_empty and network.server.counts["merged"] == 2
    assert_same(network.server.site, network.direct)


def test_a_site_that_lacks_the_last_merge_refuses(tmp_path):
    network = Network([Walker("a")], path=tmp_path / "site", engine="files")
    network.walk()
    network.exchange()
    network.server.close()
    shutil.copytree(tmp_path / "site", tmp_path / "backup")
    network.start()
    network.walk()
    network.exchange()
    network.server.close()
    shutil.rmtree(tmp_path / "site")
    shutil.move(tmp_path / "backup", tmp_path / "site")
    network.start()
    before = known_cells(network.server.site, "variance")
    network.walk()
    network.exchange()
    assert "restored backup" in str(network.outboxes["a"].error)
    assert known_cells(network.server.site, "variance") == before
    network.server.close()


def test_another_site_is_refused_after_a_while():
    network = Network([Walker("a")])
    network.walk()
    network.exchange()
    network.start()  # another one
    network.walk()
    network.exchange(3.0)
    assert network.outboxes["a"].error is None  # a second merger, which ends by itself
    network.exchange(20.0)
    assert "another site" in str(network.outboxes["a"].error)
    assert len(network.server.site) == 0


def test_a_robot_of_another_resolution_is_refused():
    server, outbox = SiteServer(None, resolution=0.2), Outbox("a", 0.1)
    server.handle(outbox.next_message(0.0), "a")
    for answer in server.step():
        outbox.receive(answer.payload, 0.0)
    assert "must have the site's resolution, 0.2 m, got 0.1 m" in str(outbox.error)


def test_robots_of_several_windows_and_sizes_merge_together():
    walkers = [Walker("a"), Walker("b", y=1.0, seed=1), Walker("c", y=-1.0, seed=2, cells=(30, 30))]
    network = Network(walkers)
    for _ in range(4):
        network.walk()
        network.exchange()
    network.drain()
    assert_same(network.server.site, network.direct)
    assert np.isclose(network.server.site.time, network.direct.time)
    assert torch.is_tensor(network.outboxes["a"].report.offsets)
