"""The live view of a loop: it shows the map, and never holds the loop up."""

import os
import signal
import sys
import threading
import time

import numpy as np
import pytest

from tests.helpers import mapped, pose, wait_for
from tests.viz.live.test_page import mapped_channels
from torchelev.viz.live import LiveView, Page


@pytest.fixture
def emap():
    return mapped(num_envs=3)


def test_it_shows_the_robot_that_was_chosen(emap, port, capsys):
    with LiveView(emap, port=port, max_share=1.0) as view:
        assert view.show(pose(num_envs=3))
        wait_for(lambda: view.num_drawn == 1)
        shown = view.page._last.map.layers["elevation"]
        view.page._env.value = 2
        wait_for(lambda: view.show(pose(num_envs=3)))
        wait_for(lambda: view.num_drawn == 2)
        other = view.page._last.map.layers["elevation"]
    assert f"http://localhost:{port}" in capsys.readouterr().out
    assert (shown == emap.layer("elevation")[0].numpy())[shown == shown].all()
    assert (other == emap.layer("elevation")[2].numpy())[other == other].all()


def test_the_components_of_a_chosen_channel_are_copied(port):
    emap, T, _ = mapped_channels()
    with LiveView(emap, port=port, max_share=1.0) as view:
        view.page._layer.value = "rgb"
        wait_for(lambda: view.show(T))
        wait_for(lambda: view.num_drawn == 1)
        assert "rgb, as seen" in view.page._legend.content
        assert "rgb.red" in view.page._last.map.layers and "heat" not in view.page._last.map.layers


def test_after_the_loop_another_robot_can_be_chosen_until_ctrl_c(emap, port):
    view = LiveView(emap, port=port, max_share=1.0)
    view.show(pose(num_envs=3))
    wait_for(lambda: view.num_drawn == 1)

    during_the_loop = view.page.on_change

    def choose():
        try:
            wait_for(lambda: view.page.on_change is not during_the_loop)
            time.sleep(0.2)
            view.page._env.value = 2
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    chooser = threading.Thread(target=choose, daemon=True)
    chooser.start()
    view.wait()
    chooser.join()
    shown = view.page._last.map.layers["elevation"]
    assert np.array_equal(shown, emap.layer("elevation")[2].numpy(), equal_nan=True)
    assert view.show(pose(num_envs=3)) is False, "it is closed"


def work(seconds):
    start = time.thread_time()
    while time.thread_time() - start < seconds:
        pass


@pytest.fixture
def drawing(monkeypatch):
    """Let drawing only do this: `drawing(work)`."""
    return lambda work: monkeypatch.setattr(Page, "draw", lambda *args: work())


@pytest.mark.slow(2)
def test_pictures_beyond_the_share_are_dropped(emap, port, drawing, monkeypatch):
    spent = []
    drawing(lambda: (work(0.01), spent.append(0.01)))
    with LiveView(emap, port=port, max_share=0.05, max_rate=1e6) as view:
        monkeypatch.setattr(view._load, "measure_idleness", lambda: 0.0)  # other programs may hold this one up
        start = time.perf_counter()
        while time.perf_counter() - start < 2.0:
            view.show(pose(num_envs=3))
            work(0.001)
        assert 2 <= len(spent) and sum(spent[:-1]) < 0.05 * 2.0


@pytest.mark.slow(6)
def test_a_loop_that_waits_is_shown_more_often(emap, port):
    def count(wait):
        with LiveView(emap, port=port, max_rate=50) as view:
            start = time.perf_counter()
            while time.perf_counter() - start < 3.0:
                view.show(pose(num_envs=3))
                wait(0.02)
            return view.num_drawn

    assert count(time.sleep) > 1.5 * count(work)


@pytest.mark.slow(1)
def test_a_slow_page_never_holds_the_loop_up(emap, port, drawing):
    drawing(lambda: time.sleep(1.0))
    with LiveView(emap, port=port, max_share=1.0, max_rate=1e6) as view:
        start = time.perf_counter()
        shown = [view.show(pose(num_envs=3)) for _ in range(50)]
        assert time.perf_counter() - start < 0.9 and sum(shown) <= 2


@pytest.mark.parametrize("wrong", [{"max_share": 0.0}, {"max_share": 1.5}, {"max_rate": 0.0}])
def test_wrong_settings_are_named(emap, port, wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))}: must"):
        LiveView(emap, port=port, **wrong)


def test_a_closed_view_shows_nothing(emap, port):
    view = LiveView(emap, port=port)
    view.close()
    assert view.show() is False


@pytest.mark.parametrize(
    "block, interactive, waits", [(None, False, 1), (None, True, 0), (True, True, 1), (False, False, 0)]
)
def test_a_map_shows_itself(emap, port, monkeypatch, block, interactive, waits):
    """A script waits at the page, an interactive session goes on."""
    waited = []
    monkeypatch.setattr(LiveView, "wait", lambda view: waited.append(view))
    monkeypatch.delitem(sys.modules, "ipykernel", raising=False)
    monkeypatch.setattr(sys, "ps1", ">>> ", raising=False) if interactive else monkeypatch.delattr(sys, "ps1", False)
    with emap.show(pose(num_envs=3), block=block, port=port) as view:
        wait_for(lambda: view.num_drawn == 1)
        assert len(waited) == waits and view.page.url.endswith(str(port))
