"""How long threads wait for each other: chosen by who wants the cores, left alone where the user has chosen."""

import itertools
import os
import threading
import time

import pytest
import torch

from tests.helpers import mapped, scan
from torchelev.ops import waiting
from torchelev.ops.waiting import BUSY, FREE, SETTINGS, RunningThreads, SpareTeam, Waits, count_own_running


class Team:
    def __init__(self):
        self.calls = []

    def start(self):
        self.calls.append("start")

    def end(self):
        self.calls.append("end")


@pytest.fixture(autouse=True)
def cores(monkeypatch):
    """Set the number of the machine's cores, at first 2."""

    def set_number(number):
        monkeypatch.setattr(os, "cpu_count", lambda: number)
        waiting.num_cores.cache_clear()

    set_number(2)
    yield set_number
    monkeypatch.undo()
    waiting.num_cores.cache_clear()


def made(count_running, clock=lambda: 0.0, sleep=lambda seconds: None, count_own=lambda: 1):
    return Waits(count_running, count_own, Team(), clock, sleep)


def updated(waits, times, num_threads=2):
    for _ in range(times):
        with waits.adapted(num_threads):
            pass


def test_waits_are_short_from_the_first_update_beside_a_process_until_it_is_gone():
    running = [2]
    waits = made(lambda: running[0])
    updated(waits, 50)
    assert waits.short and waits.team.calls == ["start"]
    running[0] = 1
    updated(waits, FREE - 1)
    assert waits.short
    updated(waits, 1)
    assert not waits.short and waits.team.calls == ["start", "end"]


def test_a_free_update_between_busy_ones_does_not_make_waits_long():
    samples = itertools.chain([2] * (BUSY + 1), itertools.cycle([1] * (FREE - 1) + [2]))
    waits = made(samples.__next__)
    updated(waits, 10 * FREE)
    assert waits.team.calls == ["start"]


def test_what_is_over_within_the_samples_changes_nothing():
    busy_once = itertools.cycle([2] * (BUSY - 1) + [1])
    pauses = []
    waits = made(busy_once.__next__, sleep=pauses.append)
    for _ in range(20):
        waits._shorten_if_busy(2, waits.count_running(), own=1)
    assert not waits.team.calls and len(pauses) == 20 * (BUSY - 1)


def test_threads_of_the_last_update_that_still_spin_are_no_other_process():
    running, now = [1], [0.0]
    waits = made(lambda: running[0], lambda: now[0])
    for _ in range(20):  # one update directly after the other
        with waits.adapted(2):
            running[0] = 2
    assert not waits.short
    running[0] = 3
    updated(waits, 1)
    assert waits.short


def test_threads_of_this_process_that_spin_after_anything_else_are_no_other_process():
    waits = made(lambda: 2, itertools.count(0.0, 1.0).__next__, count_own=lambda: 2)
    updated(waits, 20)
    assert not waits.short


def test_how_long_threads_spin_is_learned():
    running, now = [1], [0.0]
    waits = made(lambda: running[0], lambda: now[0])
    for _ in range(2):
        with waits.adapted(2):
            running[0] = 2  # the other thread spins
        now[0], running[0] = now[0] + 0.013, 1  # and has stopped
    with waits.adapted(2):
        running[0] = 2
    now[0] += 0.016
    updated(waits, 1)  # whoever runs now is another process
    assert waits.short


def test_a_free_core_for_each_thread_is_enough(cores):
    cores(8)
    waits = made(lambda: 5)
    updated(waits, 20, num_threads=4)
    assert not waits.short
    waits = made(lambda: 5)
    updated(waits, 1, num_threads=5)
    assert waits.short


@pytest.mark.parametrize("name", SETTINGS)
def test_what_the_user_has_set_is_left_alone(monkeypatch, name):
    for setting in SETTINGS:
        monkeypatch.delenv(setting, raising=False)
    waiting.process_waits.cache_clear()
    assert waiting.process_waits() is not None
    waiting.process_waits.cache_clear()
    monkeypatch.setenv(name, "")
    assert waiting.process_waits() is None and not waiting.are_waits_short()
    waiting.process_waits.cache_clear()


def test_updates_adapt_the_waits_of_several_threads_on_a_cpu(monkeypatch):
    waits = made(lambda: 3)
    monkeypatch.setattr(waiting, "process_waits", lambda: waits)
    emap, (cloud, T) = mapped(), scan(5)
    emap.update(cloud, T, T, dt=0.1)  # on one thread, as conftest says
    assert not waits.short
    torch.set_num_threads(2)
    emap.update(cloud, T, T, dt=0.1)
    assert waits.short and waiting.are_waits_short()
    with waiting.adapted_waits(torch.device("meta")):
        assert waits.team.calls == ["start"]


def test_a_spare_team_is_there_until_it_ends_and_changes_no_number_of_threads():
    torch.set_num_threads(2)
    torch.ones(2**17)  # this thread's own team
    before, team = set(os.listdir("/proc/self/task")), SpareTeam()
    team.start()
    new = set(os.listdir("/proc/self/task")) - before
    assert len(new) == 2, "a Python thread, and one more for the second core"
    team.end()
    end = time.monotonic() + 60
    while new & set(os.listdir("/proc/self/task")) and time.monotonic() < end:
        time.sleep(0.01)
    assert not new & set(os.listdir("/proc/self/task")) and torch.get_num_threads() == 2


def test_own_threads_that_run_are_counted():
    leave = threading.Event()
    sleepers = [threading.Thread(target=leave.wait) for _ in range(5)]
    for sleeper in sleepers:
        sleeper.start()
    try:
        counts = [count_own_running() for _ in range(50)]
    finally:
        leave.set()
        for sleeper in sleepers:
            sleeper.join()
    assert min(counts) == 1  # this one; threads of torch may spin for a while


def test_this_thread_is_running():
    assert RunningThreads()() >= 1
