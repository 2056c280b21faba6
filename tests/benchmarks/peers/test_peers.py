"""The comparison with other maps: what a peer is given, how it is scored, and that a new one is one small file."""

import dataclasses
import importlib.metadata
import json
import math
import sys

import numpy as np
import pytest
import torch
from click.testing import CliRunner

import benchmarks.peers.__main__ as command
from benchmarks.peers import process, report, score
from benchmarks.peers.maps import mean, minimum
from benchmarks.peers.peer import Cells, Frame, Setup
from benchmarks.peers.recordings import CAMERA, T_CAMERA, Recording, _held_out, _simulate
from torchelev.sim.exact.scenes import stairs

SETUP = Setup(0.5, (-1.0, -1.0), (4, 4), 5.0, 0.8, None)
POINTS = np.array([[0.1, 0.1, 0.2], [0.2, 0.2, 0.4], [-0.9, 0.9, 1.0], [math.nan] * 3, [5.0, 0.0, 0.0]], np.float32)


def frame(points=POINTS, height=0.0):
    T = np.eye(4)
    T[2, 3] = height
    return Frame(points, T, T, 0.1)


def recording(truth=0.0, changed=None, events=(), frames=4, reads=None):
    seen = np.ones(SETUP.cells, bool)
    heights = truth if callable(truth) else lambda scan: np.full(SETUP.cells, truth)
    return Recording("test", SETUP, [frame()] * frames, heights, seen, reads or [], changed, list(events))


def test_cells_gather_points_of_the_map_frame():
    cells = Cells(SETUP)
    cells.add(frame(height=1.0).placed())
    average, error = cells.mean()
    assert average[2, 2] == pytest.approx(1.3) and average[0, 3] == pytest.approx(2.0)
    assert error[2, 2] == pytest.approx(0.1 / math.sqrt(2)) and np.isfinite(average).sum() == 2
    assert cells.centers()[2, 1].tolist() == [0.25, -0.25]


def test_mean_and_minimum():
    for kind, height in ((mean, 0.3), (minimum, 0.2)):
        peer = kind.Map(SETUP)
        peer.update(frame())
        ground, _ = peer.ground()
        assert ground[2, 2] == pytest.approx(height) and np.isnan(ground).sum() == 14


def test_every_peer_says_what_it_is():
    peers = process.find_peers()
    assert peers[0].name == "torchelev_map" and len({peer.title for peer in peers}) == len(peers) >= 8
    assert all(peer.settings and peer.takes in ("points", "depth") for peer in peers)
    lines = {path.stem: len(path.read_text().splitlines()) for path in process.MAPS.glob("[!_]*.py")}
    assert max(lines.values()) <= 45, lines


def test_scores_by_hand():
    height = np.full(SETUP.cells, 0.1)
    height[0] = np.nan
    found = score._accuracy(height, np.full(SETUP.cells, 0.04), recording())
    assert found["rmse"] == pytest.approx(0.1) == found["bias"] and found["coverage"] == 0.75
    assert found["within_2_std"] == 0 and "rmse_at_steps" not in found and "steep_rated_safe" not in found
    nothing = score._accuracy(np.full(SETUP.cells, np.nan), None, recording())
    assert nothing == {"coverage": 0.0}


def test_steps_and_steep_cells_count_apart():
    """A step of 0.5 m that the map does not show: it errs by all of it on half of the cells."""
    truth = np.zeros(SETUP.cells)
    truth[2:] = 0.5
    walked = recording(lambda scan: truth)
    walked.setup = dataclasses.replace(SETUP, resolution=0.1)
    flat = score._accuracy(np.zeros(SETUP.cells), None, walked)
    expected = pytest.approx(0.5 / math.sqrt(2))
    assert flat["rmse"] == expected and flat["rmse_at_steps"] == expected and flat["steep_rated_safe"] == 1
    assert score._accuracy(truth, None, walked)["steep_rated_safe"] == 0


def test_reaction_counts_scans_until_most_cells_have_caught_up():
    changed = np.zeros(SETUP.cells, bool)
    changed[1, 1] = True
    moving = recording(changed=changed, events=(1, 3), frames=6, reads=list(range(6)))
    found = score._changes({0: 1.0, 1: 0.0, 2: 1.0, 3: 0.0, 4: 0.5, 5: 0.0}, np.full(SETUP.cells, 0.2), moving)
    assert found == {"reaction_scans": [1, None], "ghosts": 1.0}
    assert score._changes({}, np.zeros(SETUP.cells), recording()) == {}


def test_held_out_points_are_the_truth_of_real_scans():
    points = np.array(
        [[0.1, 0.1, z] for z in (0.28, 0.3, 0.35)] + [[-0.9, 0.9, 1.0]] + [[-0.9, -0.9, z] for z in (0.0, 0.0, 0.2)],
        np.float32,
    )
    given = np.array([[0.1, 0.1, 0.33], [0.9, 0.9, 0.0]], np.float32)
    truth, seen = _held_out(SETUP, [frame(points)], [frame(given)])
    assert truth(0)[2, 2] == pytest.approx(0.3) and np.isnan(truth(0)).sum() == 15
    assert seen.sum() == 2
    below = given - np.float32([0, 0, 0.3])  # the held-out points hit leaves, another one the ground
    assert np.isnan(_held_out(SETUP, [frame(points)], [frame(below)])[0](0)).all()


@pytest.mark.slow(6)
def test_a_walk_knows_its_ground():
    found = _simulate("stairs", stairs(), [(-0.5, 0.0), (-0.3, 0.0)], CAMERA, T_CAMERA)
    assert found.setup.pinhole is not None and 0.7 < found.setup.sensor_height < 1.0
    placed = torch.from_numpy(found.frames[-1].placed())
    height = stairs().truth(placed[:, :2])
    assert ((height - placed[:, 2]).abs() < 0.05).double().mean() > 0.7  # the others hit the risers
    assert found.seen.any() and np.isfinite(found.truth(0)).all()


@pytest.mark.slow(6)
def test_the_command_measures_and_a_new_peer_is_one_file(tmp_path, monkeypatch, cell_means):
    """Two peers and a program run as processes; another peer cannot be imported and is named."""
    walk = _simulate("stairs", stairs(), [(-0.5, 0.0), (-0.3, 0.0)], CAMERA, T_CAMERA)
    monkeypatch.setattr(command.recordings, "simulated", lambda: iter([walk]))
    only = [f"--only={name}" for name in ("torchelev_map", "mean", "vdbfusion", "cell_means")]
    options = [*only, "--program", str(cell_means), "--out", str(tmp_path)]
    done = CliRunner().invoke(command.main, options, catch_exceptions=False)
    assert (
        done.exit_code == 0
        and "VDBFusion is left out (ModuleNotFoundError: No module named 'vdbfusion')" in done.output
    )
    result = json.loads((tmp_path / "peers.json").read_text())
    assert list(result["peers"]) == ["torchelev_map", "mean", "cell_means"] and (tmp_path / "peers.png").exists()
    rows = result["recordings"]["stairs"]
    assert rows["cell_means"]["rmse"] == pytest.approx(rows["mean"]["rmse"], abs=1e-6)
    for scores in rows.values():
        assert scores["rmse"] < 0.1 and scores["coverage"] > 0.9 and 0 < scores["p50_ms"] <= scores["p99_ms"]
    text = report.tables(result)
    assert "| means of a program 1.2 |" in text and "| 1.2 | all points weigh the same |" in text
    assert text.count("**") >= 10 and "depth camera:" in text and "lidar:" not in text and text in done.output


def test_unknown_peers_are_refused():
    done = CliRunner().invoke(command.main, ["--only", "nothing"])
    assert done.exit_code == 2 and "no peer nothing; there are torchelev_map, cloth" in done.output


def test_a_python_that_lacks_a_package_is_passed_over():
    (found,) = (peer for peer in process.find_peers() if peer.name == "mean")
    assert process.find_python(found, ["/bin/false", sys.executable]) == (sys.executable, ["/bin/false failed"])
    assert process.find_python(found, ["/bin/false", "/nowhere/python"])[0] is None
    assert process.version_of(found, sys.executable) == ""
    own = process.find_peers()[0]
    assert process.version_of(own, sys.executable) == importlib.metadata.version("torchelev")


def test_the_best_of_a_column_is_bold_and_who_never_reacts_is_named():
    row = {"rmse": 0.02, "p50_ms": 2.0, "reaction_scans": [3, None]}
    peers = {name: {"title": name, "version": "1", "settings": "s"} for name in ("a", "b")}
    scores = {"stairs": {"a": row, "b": {**row, "rmse": 0.01, "reaction_scans": [3]}}}
    lines = report.table({"peers": peers, "recordings": scores}, report.CAMERA).splitlines()
    assert [cell.strip() for cell in lines[2].split("|")[1:-1]] == ["a 1", "2.0", "never", "**2.0**"]
    assert [cell.strip() for cell in lines[3].split("|")[1:-1]] == ["b 1", "**1.0**", "**3**", "**2.0**"]


def test_a_peer_that_ends_early_says_why():
    (found,) = (peer for peer in process.find_peers() if peer.name == "mean")
    with pytest.raises(RuntimeError, match="mean of each cell ended early: .*No module named"):
        process.Process(found._replace(name="nothing"), sys.executable, SETUP)


def test_ranges_are_of_the_known_ground():
    true = np.array([[0.0, np.nan, 0.3], [np.nan, np.nan, np.nan], [np.nan, np.nan, np.nan]])
    found = score._range(true, 3)
    assert found[0].tolist() == pytest.approx([0.0, 0.3, 0.0]) and found[2, 0] < 0


def test_a_file_that_lacks_a_constant_is_named(tmp_path, monkeypatch):
    (tmp_path / "median.py").write_text('TITLE, NEEDS = "median", ""')
    monkeypatch.setattr(process, "MAPS", tmp_path)
    with pytest.raises(ValueError, match="median.py: must set SETTINGS, TAKES"):
        process.find_peers()


def test_errors_of_each_recording_stand_beside_the_coverage():
    peers = {name: {"title": name, "version": "1", "settings": "s"} for name in ("a", "b")}
    both = {"a": {"rmse": 0.02, "coverage": 1.0}, "b": {"rmse": 0.011, "coverage": 0.5}}
    result = {"peers": peers, "recordings": {"x": both, "y": {"a": {"rmse": 0.03, "coverage": 1.0}}}}
    rows = [line.split("|")[1:-1] for line in report.by_recording(result).splitlines()[2:]]
    found = [[cell.strip() for cell in row] for row in rows]
    assert found == [["a", "2.0 (100)", "**3.0** (100)"], ["b", "**1.1** (50)", ""]]
