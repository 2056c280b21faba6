"""A recording on disk, and the command line as a function."""

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
