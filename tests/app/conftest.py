"""A recording on disk, and the command line as a function."""

import math

import numpy as np
import pytest

from tests.app.drives import sensor_poses, world_points, write_poses
from torchelev.app.cli import main
from torchelev.io import MappingRun


@pytest.fixture
def recording(tmp_path):
    folder = tmp_path / "drive"
    (folder / "scans").mkdir(parents=True)
    for k, pose in enumerate(sensor_poses()):
        points = (world_points(k) - pose[:3, 3]) @ pose[:3, :3]
        np.hstack([points, np.ones((len(points), 1))]).astype(np.float32).tofile(folder / "scans" / f"{k:06d}.bin")
    write_poses(folder / "poses.txt", sensor_poses())
    return folder


@pytest.fixture
def run(capsys, tmp_path, monkeypatch):
    """Run the program in an empty folder -> exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)

    def call(*args):
        capsys.readouterr()
        with pytest.raises(SystemExit) as left:
            main([str(arg) for arg in args], prog_name="torchelev")
        return left.value.code, *capsys.readouterr()

    return call


@pytest.fixture
def at_scan(monkeypatch):
    """Let something happen before the scan of a number is mapped: `at_scan(number, action)`."""

    def prepare(number, action):
        add = MappingRun.add

        def watched(self, *arguments):
            if self.num_scans == number:
                action()
            return add(self, *arguments)

        monkeypatch.setattr(MappingRun, "add", watched)

    return prepare


class Shown(list):
    """The page, and what it drew: snapshots, and what came with them. Ctrl-C is pressed at the last one of `most`."""

    most = math.inf
    page = None


@pytest.fixture
def shown(monkeypatch):
    """What pages draw. Recordings are played at once, and Ctrl-C is pressed at their end."""
    from torchelev.viz import live

    shown = Shown()

    class Page(live.Page):
        def draw(self, snapshot, *args):
            shown.append((snapshot, *args))
            shown.page = self
            super().draw(snapshot, *args)
            if len(shown) == shown.most:
                raise KeyboardInterrupt

        def wait(self):
            raise KeyboardInterrupt

    class Player(live.Player):
        def hold(self):
            raise KeyboardInterrupt

        def _wait_until_due(self, time_now):
            pass

        def _is_due(self, number):
            return True

    monkeypatch.setattr(live, "Page", Page)
    monkeypatch.setattr(live, "Player", Player)
    return shown
