"""The warning of updates that have become many times slower, by a clock of the test's own."""

import warnings

import pytest
import torch

from tests.helpers import mapped, scan
from torchelev.diagnosis import update_times
from torchelev.diagnosis.update_times import PATIENCE, WINDOW, UpdateTimes


@pytest.fixture(autouse=True)
def _not_warned(monkeypatch):
    monkeypatch.setattr(update_times, "has_warned", False)
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)  # `make test` sets it
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def noted(times, num_points=1000, watch=None):
    watch = watch or UpdateTimes()
    for seconds in times:
        watch.note(seconds, num_points)
    return watch


USUAL = [0.008, 0.009, 0.01] * 20
ENOUGH = WINDOW // 2 + PATIENCE  # until the median, and then for so many updates


def test_updates_of_nine_times_their_usual_are_told_once_with_the_cure():
    watch = noted([*USUAL, *[0.08] * (ENOUGH - 1)])
    with pytest.warns(RuntimeWarning, match=r"80 ms .*OMP_WAIT_POLICY=PASSIVE .*before torch.*torch.set_num_threads"):
        noted([0.08], watch=watch)
    noted([0.08] * 50, watch=watch)
    noted([*USUAL, *[0.08] * 50])  # another map of the same process


@pytest.mark.parametrize("by_user", [True, False])
def test_short_waits_are_not_proposed_where_they_are(monkeypatch, by_user):
    if by_user:
        monkeypatch.setenv("OMP_WAIT_POLICY", "passive")
    else:
        monkeypatch.setattr(update_times, "are_waits_short", lambda: True)
    with pytest.warns(RuntimeWarning, match=r"same cores\. Call torch.set_num_threads") as caught:
        noted([*USUAL, *[0.08] * ENOUGH])
    assert "PASSIVE" not in str(caught[0].message) and "spin" not in str(caught[0].message)


@pytest.mark.parametrize(
    "times",
    [
        [60.0, 40.0, 30.0, *USUAL, 50.0, 50.0, 50.0, *USUAL],  # three graphs are compiled, and again
        [*USUAL, *[0.04] * 100],  # not five times
        [*USUAL, *[0.5, 0.009, 0.009] * 30],  # single ones
        [0.08] * 100,  # as from the start
        [*[0.08] * 20, *USUAL],  # faster
    ],
)
def test_no_warning_without_cause(times):
    noted(times)


def test_clouds_that_take_turns_do_not_hide_each_other():
    watch = UpdateTimes()
    for _ in range(60):
        noted([0.008], 1000, watch)
        noted([0.02], 100_000, watch)
    with pytest.warns(RuntimeWarning, match="80 ms"):
        for _ in range(60):
            noted([0.08], 1000, watch)
            noted([0.02], 100_000, watch)


def test_larger_clouds_and_fewer_threads_are_told_apart():
    watch = noted(USUAL)
    noted([0.08] * 50, num_points=10_000, watch=watch)
    torch.set_num_threads(2)  # the suite's own fixture sets it back
    noted([0.08] * 50, watch=watch)


def test_updates_are_timed_by_the_maps_clock():
    emap, (cloud, T) = mapped(), scan(5)
    ticks = iter([t for k in range(40) for t in (k, k + (0.01 if k < 20 else 0.2))])
    emap.update_times = UpdateTimes(lambda: next(ticks))
    for _ in range(19 + ENOUGH):
        emap.update(cloud, T, T, dt=0.1)
    with pytest.warns(RuntimeWarning, match="update: the last 9 updates took 200 ms"):
        emap.update(points=cloud, T_map_sensor=T, T_map_base=T, dt=0.1)


def test_updates_on_other_devices_are_not_timed():
    noted = []

    class Noted(UpdateTimes):
        def note(self, seconds, num_points):
            noted.append(num_points)

    emap, (cloud, _) = mapped(), scan(5)
    emap.update_times = Noted()
    on_other_device = torch.empty(cloud.shape, device="meta")
    update_times.timed(lambda *_: None)(emap, on_other_device)
    assert not noted
    update_times.timed(lambda *_: None)(emap, cloud)
    assert noted == [600]
