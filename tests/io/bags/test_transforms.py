"""What is wrong with a tree of transforms is said."""

import numpy as np
import pytest

from tests.io.bags.synthetic import DEPTH, START, Writer, base_at, drive, write_drive
from tests.io.bags.test_recording import map_bag
from torchelev.io.bags import BagRequest, TransformTree

POSE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def write_poses(path, transforms, keep=lambda stamp: True, end=0.9):
    """A bag of the drive's clouds, and poses of each (parent, child) until an end [s] where they are kept."""
    writer = Writer(path, "mcap")
    stamps = START + np.arange(-0.3, end, 0.02)
    for stamp, T in zip(stamps, base_at(stamps).numpy(), strict=True):
        for parent, child in transforms:
            if keep(stamp):
                writer.transform(stamp, parent, child, T)
    for scan in drive().clouds:
        writer.cloud(scan, time="timestamp")
    writer.close()
    return path


def test_a_frame_with_two_parents_is_named(tmp_path):
    path = write_poses(tmp_path / "drive", [("map", "lidar"), ("odom", "lidar")])
    _, _, recording = map_bag(path)
    words = "lidar has several parents in the transforms, map and odom: only its last poses in odom are used"
    assert words in " ".join(recording.warnings)


@pytest.mark.slow(1)
def test_requested_poses_take_the_place_of_transforms(tmp_path):
    """Odometry says odom -> base_link, and /tf another parent."""
    plain = map_bag(write_drive(tmp_path, depth=False), BagRequest(poses="/odom"))[1]
    (tmp_path / "other").mkdir()
    transform = Writer.transform

    def renamed(self, stamp, parent, child, T, is_static=False):
        transform(self, stamp, "map" if parent == "odom" else parent, child, T, is_static)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Writer, "transform", renamed)
        path = write_drive(tmp_path / "other", depth=False)
    _, frames, recording = map_bag(path, BagRequest(poses="/odom"))
    assert recording.map_frame == "odom" and not recording.warnings and len(frames) == len(plain)
    for frame, other in zip(frames, plain, strict=True):
        np.testing.assert_array_equal(frame.T_map_sensor, other.T_map_sensor)


def test_a_gap_in_the_poses_is_said_with_its_time():
    tree = TransformTree()
    for stamp in [*np.arange(0.0, 5.0, 0.1), *np.arange(7.4, 9.0, 0.1), *np.arange(10.2, 12.0, 0.1)]:
        tree.add("odom", "base", START + stamp, POSE)
    tree.add("base", "lidar", START, POSE, is_static=True)
    (line,) = tree.describe_gaps("odom", "lidar", 1.0)
    assert line.startswith(f"base has no pose in odom for 2.5 s, from 4.9 s after its first (stamp {START + 4.9:.3f})")
    assert "and 1 more: scans there" in line
    assert not tree.describe_gaps("base", "lidar", 1.0) and not tree.describe_gaps("odom", "lidar", 3.0)
    assert tree.describe_gaps("lidar", "odom", 1.0) == [line]


def test_a_recording_warns_of_a_gap(tmp_path):
    path = write_poses(tmp_path / "drive", [("odom", "lidar")], lambda t: not 0.1 < t - START < 1.65, end=2.0)
    _, _, recording = map_bag(path)
    (line,) = recording.warnings
    assert line.startswith("lidar has no pose in odom for 1.6 s, from 0.4 s after its first")


@pytest.mark.slow(1)
def test_a_good_drive_is_not_warned_of(tmp_path):
    assert not map_bag(write_drive(tmp_path), BagRequest(clouds=["/lidar/points"], depths=[DEPTH]))[2].warnings
