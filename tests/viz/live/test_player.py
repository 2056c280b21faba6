"""Play, pause, step and scrub."""

import functools
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from tests.helpers import mapped, wait_for
from torchelev.viz.live import Page, Player, take_snapshot
from torchelev.viz.live.player import History

SCANS = 12


@pytest.fixture(scope="module")
def snapshot():
    return take_snapshot(mapped(num_envs=1), np.eye(4))


@pytest.fixture
def player(port, snapshot):
    """A player, at the fifth scan of a recording of which a scan is due every 20 ms."""
    page = Page("test", snapshot_layers(snapshot), port=port)
    yield SimpleNamespace(page=page, made=Player(page, SCANS, is_playing=False))
    page.stop()


def snapshot_layers(snapshot):
    return tuple(snapshot.map.layers)


def play(player, snapshot, spacing=0.02):
    """Feed all scans in a thread, as mapping does."""

    def feed():
        for k in range(SCANS):
            player.made.show(snapshot._replace(time=spacing * k))

    thread = threading.Thread(target=feed, daemon=True)
    thread.start()
    return thread


def scrub(player, number):
    player.made._scrub(SimpleNamespace(client=object(), target=SimpleNamespace(value=number)))


@pytest.mark.slow(1)
def test_paused_it_waits_and_steps_one_by_one(player, snapshot):
    play(player, snapshot)
    wait_for(lambda: player.made.num_shown == 1)
    for expected in (2, 3, 4):
        player.made._press("step")
        wait_for(functools.partial(has_status, player, f"Scan {expected} of {SCANS}"))
        time.sleep(0.1)
        assert player.made.num_shown == expected


def has_status(player, start):
    return player.page._status.content.startswith(start)


@pytest.mark.slow(1)
def test_it_plays_in_the_recordings_time(player, snapshot):
    thread = play(player, snapshot, spacing=0.1)
    wait_for(lambda: player.made.num_shown == 1)
    start = time.monotonic()
    player.made._press("play")
    thread.join(30)
    taken = time.monotonic() - start
    assert not thread.is_alive() and taken > 0.9 * (SCANS - 2) * 0.1
    player.made._press("pause")


def test_a_higher_speed_is_faster(player, snapshot):
    player.made._speed.value = "max"
    thread = play(player, snapshot, spacing=100.0)
    player.made._press("play")
    thread.join(30)
    assert not thread.is_alive() and player.made.num_shown == SCANS


def test_scrubbing_ahead_maps_up_to_there_and_back_shows_what_was(player, snapshot):
    play(player, snapshot, spacing=100.0)
    scrub(player, 8)
    wait_for(lambda: player.page._status.content.startswith("Scan 8 "))
    assert player.made.num_shown == 8
    scrub(player, 3)
    wait_for(lambda: player.page._status.content == f"Scan 3 of {SCANS}, 200.0 s")
    assert player.made.num_shown == 8  # nothing is mapped again
    player.made._press("back")
    wait_for(lambda: player.page._status.content.startswith("Scan 2 "))
    player.made._press("step")
    wait_for(lambda: player.page._status.content.startswith("Scan 3 "))


def test_play_from_an_earlier_scan_goes_on_at_the_last_one(player, snapshot):
    thread = play(player, snapshot)
    scrub(player, 6)
    wait_for(lambda: player.made.num_shown == 6)
    scrub(player, 2)
    wait_for(lambda: player.page._status.content.startswith("Scan 2 "))
    player.made._press("play")
    thread.join(30)
    assert player.made.num_shown == SCANS


@pytest.mark.slow(1)
def test_after_the_last_scan_play_shows_it_all_again(player, snapshot):
    player.made._speed.value = "max"
    thread = play(player, snapshot)
    player.made._press("play")
    thread.join(30)
    threading.Thread(target=player.made.hold, daemon=True).start()
    wait_for(lambda: player.made._is_over)
    player.made._speed.value = "0.25x"
    player.made._press("play")
    wait_for(lambda: has_status(player, "Scan 2 "))
    player.made._press("pause")
    time.sleep(0.2)
    assert player.made._shown < SCANS - 1 and player.made.num_shown == SCANS


def test_the_history_has_bounded_memory(snapshot):
    history = History(max_bytes=10 * snapshot.nbytes)
    for k in range(100):
        history.add(k, snapshot._replace(time=float(k)))
    assert history._num_bytes <= 10 * snapshot.nbytes and len(history._numbers) >= 5
    assert history.at(99).time >= 80 and history.at(0).time == 0 and history.at(50).time <= 50
