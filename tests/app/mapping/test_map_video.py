"""`torchelev map --video`: the growing map as a video."""

import os

import numpy as np
import pytest

from tests.app.drives import NUM_SCANS, raise_interrupt
from tests.helpers import without
from tests.io.bags.synthetic import SCANS, write_drive
from tests.viz.test_video import read_frames
from torchelev.app.mapping import map_video
from torchelev.app.mapping.recording_schedule import RecordingSchedule
from torchelev.io import Frame


def count_unknown(frames):
    return (frames == 217).all(-1).sum((1, 2))


@pytest.mark.slow(2)
@pytest.mark.parametrize("name", ["grown.mp4", "grown.gif"])
def test_a_bag_becomes_a_video(run, tmp_path, name):
    pytest.importorskip("av")
    code, out, err = run("map", write_drive(tmp_path), "--size", 4, "--video", name)
    assert (code, err) == (0, "") and f"filmed    {SCANS} frames in {name}" in out
    frames = read_frames(tmp_path / name)
    assert len(frames) == SCANS and min(frames.shape[1:3]) > 400
    assert count_unknown(frames[-1:])[0] < count_unknown(frames[:1])[0]


@pytest.mark.slow(2)
def test_a_folder_becomes_a_video_and_maps_again_beside_it(run, recording, monkeypatch):
    monkeypatch.chdir(recording / "scans")
    (recording / "poses.txt").rename(recording / "scans" / "poses.txt")
    for _ in range(2):
        code, out, err = run("map", ".", "--size", 4, "--video", "grown.gif", "--every", 0)
        assert (code, err) == (0, "") and f"filmed    {NUM_SCANS} frames" in out


@pytest.mark.slow(1)
def test_frames_and_maps_share_a_time_and_the_last_map_is_shown(run, tmp_path):
    options = ("--video", "grown.gif", "--grid-map", "grown.mcap", "--every", 0.2)
    code, out, _ = run("map", write_drive(tmp_path), "--size", 4, *options)
    assert code == 0 and "recorded  3 maps" in out and "filmed    4 frames" in out


@pytest.mark.slow(1)
def test_a_long_recording_gives_a_video_of_bounded_length(run, recording, tmp_path, monkeypatch):
    monkeypatch.setattr(map_video, "_MAX_FRAMES", 2)
    assert run("map", recording, "--size", 4, "--video", "grown.gif")[0] == 0
    assert len(read_frames(tmp_path / "grown.gif")) == 3  # and the last map


def test_recording_schedule():
    frame = Frame(np.zeros((0, 3), np.float32), np.eye(4), 0.1, "")
    for (seconds, scans), expected in {
        (0.0, 1): range(10), (0.0, 4): (0, 4, 8), (0.3, 1): (0, 3, 6, 9), (0.05, 2): (0, 2, 4, 6, 8)
    }.items():  # fmt: skip
        schedule = RecordingSchedule(seconds, scans)
        assert [k for k in range(10) if schedule.is_due(frame)] == list(expected)


@pytest.mark.slow(1)
@pytest.mark.parametrize("name", ["grown.mp4", "grown.gif"])
def test_ctrl_c_keeps_the_video_so_far(run, recording, tmp_path, at_scan, name):
    pytest.importorskip("av")
    at_scan(3, raise_interrupt)
    code, out, err = run("map", recording, "--size", 4, "--video", name)
    assert code == 130 and "kept the map of 3 of 4 scans" in err and "filmed    3 frames" in out
    assert len(read_frames(tmp_path / name)) == 3 and (tmp_path / "map.npz").exists()


@pytest.mark.slow(1)
def test_the_map_is_kept_where_the_video_cannot_be_finished(run, recording, tmp_path, monkeypatch):
    replace = os.replace

    def full_disk(source, target):
        if str(target).endswith(".gif"):
            raise OSError(28, "No space left on device")
        replace(source, target)

    monkeypatch.setattr(os, "replace", full_disk)
    code, _, err = run("map", recording, "--size", 4, "--video", "grown.gif")
    assert code == 2 and "grown.gif: cannot be written (No space left on device)" in err
    assert "kept the map of 4 of 4 scans" in err
    assert (tmp_path / "map.partial.npz").exists()


@pytest.mark.parametrize(("name", "words"), {
    "grown.avi": "--video: must end in .mp4 or .gif, got grown.avi",
    "gone/grown.gif": "gone/grown.gif: cannot be written",
    "grown.mp4": "pip install 'torchelev[video]'",
}.items())  # fmt: skip
def test_what_cannot_be_filmed_is_refused_before_mapping(run, recording, tmp_path, monkeypatch, at_scan, name, words):
    without(monkeypatch, "av")
    at_scan(0, lambda: pytest.fail("mapped"))
    code, out, err = run("map", recording, "--video", name, "--grid-map", "grown.mcap")
    assert (code, out) == (2, "") and words in err and len(err.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["drive"]
