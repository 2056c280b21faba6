"""The demo's walk as a recording: the other commands read it without options."""

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from torchelev.app.cli import main
from torchelev.app.demo.recording import TOPIC, record_demo
from torchelev.app.demo.walk import CAMERA, DemoWalk
from torchelev.io.bags.bag import Bag
from torchelev.io.bags.recording import open_bag
from torchelev.io.map_file import load_map

pytest.importorskip("rosbags")
SCANS = 4  # of 0.2 s


@pytest.fixture(scope="module")
def walk():
    return list(DemoWalk(0.2 * SCANS).observe())


@pytest.mark.slow(8)
@pytest.mark.parametrize("name", ["drive.mcap", "drive.bag", "drive"])
def test_what_is_recorded_is_what_was_seen(tmp_path, walk, name):
    assert record_demo(tmp_path / name, 0.2 * SCANS, progress=False) == SCANS
    with Bag(tmp_path / name) as bag:
        recording = open_bag(bag)
        frames = list(recording)
        assert recording.topics == [f"{TOPIC}/image_rect_raw"] and recording.map_frame == "odom"
    assert len(frames) == SCANS
    for frame, scan in zip(frames, walk, strict=True):
        points = frame.points[np.isfinite(frame.points).all(1)]
        placed = torch.from_numpy(points).double() @ torch.from_numpy(frame.T_map_sensor[:3, :3]).T
        seen = scan.points[scan.points.isfinite().all(-1)].double() @ scan.T_map_sensor[:3, :3].T
        assert len(placed) == len(seen) <= CAMERA.width * CAMERA.height
        assert (placed - seen).norm(dim=-1).max() < 2e-3  # depth is in millimetres
        torch.testing.assert_close(torch.from_numpy(frame.T_map_base), scan.T_map_base, atol=1e-9, rtol=0)


@pytest.mark.slow(8)
def test_the_commands_map_it_without_options(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(main, ["demo", "--record", "drive.mcap", "--seconds", "0.8", "--quiet"])
    assert done.exit_code == 0 and done.output == "wrote 4 depth images and their poses to drive.mcap\n"
    done = CliRunner().invoke(main, ["map", "drive.mcap"])
    assert done.exit_code == 0, done.output
    scene, emap = DemoWalk(0.2).scene, load_map(tmp_path / "map.npz")
    known = emap.validity[0]
    error = emap.elevation[0][known] - scene.truth(emap.cell_centers()[0][known])
    assert known.sum() > 1000 and error.abs().median() < 0.01


def test_what_cannot_be_recorded_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(main, ["demo", "--record", "drive.txt"])
    assert done.exit_code != 0 and "must be a bag's, got drive.txt" in done.output
    done = CliRunner().invoke(main, ["demo", "--record", "drive.mcap", "--seconds", "-1"])
    assert done.exit_code != 0 and "seconds: must be positive" in done.output and not list(tmp_path.iterdir())


def test_a_recording_that_is_interrupted_leaves_the_older_one(tmp_path, monkeypatch):
    (tmp_path / "drive.mcap").write_bytes(b"older")

    def interrupted(walk):
        yield next(iter(observe(walk)))
        raise KeyboardInterrupt

    observe = DemoWalk.observe
    monkeypatch.setattr(DemoWalk, "observe", interrupted)
    with pytest.raises(KeyboardInterrupt):
        record_demo(tmp_path / "drive.mcap", 0.8, progress=False)
    assert [path.name for path in tmp_path.iterdir()] == ["drive.mcap"]
    assert (tmp_path / "drive.mcap").read_bytes() == b"older"
