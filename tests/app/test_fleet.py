"""`torchelev fleet`, from end to end."""

import json
import os
import signal
from importlib.util import find_spec

import numpy as np
import pytest
import torch

pytest.importorskip("matplotlib")
pytest.importorskip("tqdm")

from tests.app.drives import raise_interrupt
from torchelev.app.fleet.command import finish
from torchelev.app.fleet.mission import DT, Mission
from torchelev.app.fleet.numbers import measure_seams
from torchelev.app.fleet.request import FleetRequest

SMALL = ("--robots", 3, "--size", 12, "--seconds", 4)


@pytest.fixture
def at_scan(monkeypatch):
    """Let something happen before the scan of a number is mapped, of -1: before anything is computed."""

    def prepare(number, action):
        class Watched(Mission):
            def __init__(self, *arguments):
                if number == -1:
                    action()
                super().__init__(*arguments)

            def step(self):
                if self.num_scans == number:
                    action()
                super().step()

        monkeypatch.setattr("torchelev.app.fleet.command.Mission", Watched)

    return prepare


@pytest.mark.slow(4)
def test_a_fleet_maps_draws_and_measures(run, tmp_path):
    code, out, err = run("fleet", *SMALL, "--out", "three.png")
    assert code == 0 and "100%" in err and "coverage=" in err and "robots=3" in err and "merge=" in err
    for word in ("coverage", "RMSE", "seams", "offsets", "update", "merge", "on disk", "took", "wrote three.png"):
        assert word in out
    assert (tmp_path / "three.png").read_bytes().startswith(b"\x89PNG")
    numbers = json.loads((tmp_path / "three.json").read_text())
    assert 0.3 < numbers["coverage"] <= 1 and numbers["coverage"] == numbers["history"][-1][1]
    assert numbers["rmse_off_steps"] < 0.03 and numbers["largest_offset_error"] < 0.02
    assert len(numbers["offsets"]) == 3 and numbers["num_bytes"] >= 0 and numbers["walked"] > 3


@pytest.mark.slow(4)
def test_no_robot_climbs_or_leaves():
    mission = Mission(FleetRequest(robots=4, size=16.0, seconds=12.0), None)
    while not mission.is_done:
        mission.step()
    tracks = np.array(mission.robots.tracks)
    assert np.abs(tracks).max() < 8.0 and np.hypot(*np.diff(tracks, axis=0).T).max() < 1.3 * DT
    rises = np.abs(np.diff(mission.world.truth(torch.as_tensor(tracks)), axis=0))
    assert rises.max() < 0.3 and mission.coverage > 0.7


@pytest.mark.slow(1)
def test_a_mission_repeats_by_its_seed():
    def run(seed):
        mission = Mission(FleetRequest(robots=2, size=10.0, seconds=1.5, seed=seed), None)
        while not mission.is_done:
            mission.step()
        return mission.saved.layers["elevation"]

    first, second, other = run(0), run(0), run(1)
    assert np.array_equal(first, second, equal_nan=True) and not np.array_equal(first, other, equal_nan=True)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--robots", 0), "--robots: must be a positive int, got 0"),
        (("--robots", 300), "--robots: must be at most 256"),
        (("--size", 5), "--size: must hold the camp of 16 robots, got 5 m; give 13 or more"),
        (("--size", 20.3), "--size: must be a whole number of times 1 m"),
        (("--size", "nan"), "--size: must be a positive number"),
        (("--size", 900), "--size: must be at most 150"),
        (("--resolution", -1), "--resolution: must be a positive number"),
        (("--resolution", 2), "--resolution: must lie in [0.04, 0.25] m, got 2"),
        (("--seconds", 0), "--seconds: must be a positive number of seconds, got 0"),
        (("--seed", -1), "--seed: must be"),
        (("--out", "numbers.json"), "--out: must end with .png"),
        (("--out", "nowhere/fleet.png"), "nowhere/fleet.png: cannot be written"),
    ],
)
def test_bad_input_is_refused_before_anything_is_computed(run, at_scan, options, words):
    at_scan(-1, lambda: pytest.fail("computed"))
    code, out, err = run("fleet", *options)
    assert code == 2 and words in err and err.count("\n") == 1


@pytest.mark.slow(2)
def test_ctrl_c_keeps_what_was_mapped(run, at_scan, tmp_path):
    at_scan(7, lambda: os.kill(os.getpid(), signal.SIGINT))
    code, out, err = run("fleet", *SMALL, "--quiet")
    assert code == 130 and "interrupted: kept the map of 1 of 4 s" in err
    assert json.loads((tmp_path / "fleet.json").read_text())["history"][-1][0] == pytest.approx(7 * DT)
    assert (tmp_path / "fleet.png").exists() and "coverage" in out


def test_ctrl_c_before_the_first_scan_writes_nothing(run, at_scan, tmp_path):
    at_scan(0, raise_interrupt)
    code, out, err = run("fleet", *SMALL, "--quiet")
    assert (code, out) == (130, "") and "nothing was mapped" in err and not list(tmp_path.iterdir())


@pytest.mark.slow(4)
def test_a_site_on_disk_is_continued(run, tmp_path):
    pytest.importorskip("tensorstore", reason="needs torchelev[site]")
    options = ("--robots", 2, "--size", 12, "--seconds", 2, "--site", tmp_path / "hill", "--quiet")
    histories = []
    for name in ("a.png", "b.png"):
        code, out, err = run("fleet", *options, "--out", name)
        assert (code, err) == (0, "") and f"{tmp_path / 'hill'}" in out
        numbers = json.loads((tmp_path / name).with_suffix(".json").read_text())
        assert numbers["num_bytes"] > 0 and numbers["rmse_off_steps"] < 0.03
        histories.append(numbers["history"])
    assert histories[1][0][1] >= histories[0][-1][1]
    code, out, err = run("fleet", *options, "--resolution", 0.2)
    assert code == 2 and "must be 0.1 m" in err and err.count("\n") == 1


def test_help_says_what_happens(run):
    code, out, _ = run("fleet", "--help")
    assert code == 0 and max(map(len, out.splitlines())) <= 80
    for word in ("--robots", "frontiers", "fleet.json", "Ctrl-C", "--site", "--live", "offsets"):
        assert word in out


@pytest.mark.slow(2)
def test_live_shows_the_site_and_the_robots(run, port, request):
    pytest.importorskip("viser", reason="needs torchelev[view]")
    shown = request.getfixturevalue("shown")
    code, out, err = run("fleet", *SMALL[:4], "--seconds", 2, "--live", "--port", port, "--quiet")
    assert (code, err) == (0, "") and f"open      http://localhost:{port}" in out
    assert ("merger    " in out) == bool(find_spec("zenoh") and find_spec("tensorstore"))
    assert [status[:4] for _, status in shown] == ["0 s,", "1 s,", "2 s,"]
    assert shown[-1][0].T_map_sensor.shape == (3, 4, 4) and shown[-1][0].map.layers["elevation"].shape == (120, 120)


@pytest.mark.slow(6)
def test_robots_send_to_a_merger_in_another_process(run, tmp_path):
    pytest.importorskip("zenoh", reason="needs torchelev[serve]")
    pytest.importorskip("tensorstore", reason="needs torchelev[serve]")
    histories = []
    for options in ("--service",), ("--no-service",):
        code, out, err = run("fleet", *SMALL, "--quiet", "--site", options[0][2:], *options)
        assert (code, err) == (0, "") and ("merger    a process of its own" in out) == (options[0] == "--service")
        numbers = json.loads((tmp_path / "fleet.json").read_text())
        assert numbers["num_bytes"] > 0 and numbers["largest_offset_error"] < 0.02
        histories.append(numbers["history"])
    assert np.allclose(histories[0], histories[1], atol=0.02)  # robots arrive one by one, and are aligned so


def test_seams_are_steps_between_blocks():
    error = np.zeros((40, 40))
    assert measure_seams(error, 0.1) == 0.0
    error[:, 20:] = 0.04  # between two of four columns of blocks: 4 of 24 pairs
    assert measure_seams(error, 0.1) == pytest.approx(0.04)
    assert np.isnan(measure_seams(np.full((40, 40), np.nan), 0.1))


@pytest.mark.slow(2)
def test_numbers_are_written_in_place_of_older_ones(tmp_path):
    request = FleetRequest(robots=1, size=10.0, seconds=0.2, out=tmp_path / "one.png")
    (tmp_path / "one.json").write_text("old")
    mission = Mission(request, None)
    mission.step()
    numbers = finish(mission, 0.0)
    assert json.loads(request.numbers.read_text())["robots"] == 1 and "1 robot, 0 s" in str(numbers)
