"""Names of scans: times, counters and sensors; and files with too many poses."""

import numpy as np
import pytest

from tests.io.folders.test_recording import write_kitti, write_scans, write_tum
from torchelev.io import RecordingError, open_recording
from torchelev.io.folders.scan_files import parse_stamp


@pytest.mark.parametrize(
    ("stem", "stamp"),
    [
        ("0000000005", None),
        ("0000000000000000005", None),
        ("5000000000", None),
        ("12.5", 12.5),
        ("1700000000", 1.7e9),
        ("1700000000123", 1700000000.123),
        ("1700000000_250000000", 1700000000.25),
        ("frame_1700000000.5", 1700000000.5),
        ("n015-2018-07-24-11-22-45+0800__LIDAR_TOP__1532402927647951.pcd", 1532402927.647951),
        ("scan_12", None),
    ],
)
def test_times_in_names(stem, stamp):
    assert parse_stamp(stem) == (None if stamp is None else pytest.approx(stamp, abs=1e-6))


def test_counters_of_ten_digits_pair_in_order(tmp_path):
    write_scans(tmp_path, [f"{k:010}" for k in range(4)])
    write_tum(tmp_path / "poses.txt", 0.1 * np.arange(40))
    recording = open_recording(tmp_path)
    assert recording.T_map_sensor[:, 0, 3].tolist() == [0, 1, 2, 3] and "takes line 1" in recording.note


def test_times_order_scans(tmp_path):
    write_scans(tmp_path, ["1.5", "1.25"])
    write_tum(tmp_path / "poses.txt", [1.25, 1.5])
    assert [frame.name for frame in open_recording(tmp_path)] == ["1.25.npy", "1.5.npy"]


@pytest.mark.parametrize("first", [0, 1])
def test_which_of_13_poses_is_too_many_for_12_scans_is_ambiguous(tmp_path, first):
    write_scans(tmp_path, [f"{first + k:06}" for k in range(12)])
    write_kitti(tmp_path / "poses.txt", range(13))
    with pytest.raises(
        RecordingError, match=f"13 poses for 12 scans: which line belongs to 00000{first}.npy is ambiguous"
    ):
        open_recording(tmp_path)


def test_13_poses_with_times_for_12_scans_named_by_time(tmp_path):
    write_scans(tmp_path, [f"{1.7e9 + 0.1 * k:.6f}" for k in range(1, 13)])
    write_tum(tmp_path / "poses.txt", 1.7e9 + 0.1 * np.arange(13))
    assert open_recording(tmp_path).T_map_sensor[:, 0, 3].tolist() == list(range(1, 13))


def test_clocks_that_differ_are_named(tmp_path):
    write_scans(tmp_path, ["1700000000.0", "1700000000.1"])
    write_tum(tmp_path / "poses.txt", [5.0, 5.1])
    assert "the clocks differ" in open_recording(tmp_path).note
    write_tum(tmp_path / "poses.txt", [5.0, 5.1, 5.2])
    with pytest.raises(RecordingError, match="the clocks differ"):
        open_recording(tmp_path)


def test_scans_of_two_sensors_are_refused(tmp_path):
    write_scans(tmp_path, ["front_0", "front_1", "rear_0", "rear_1"])
    write_kitti(tmp_path / "poses.txt", range(4))
    with pytest.raises(RecordingError, match=r"several sensors: front_0\.npy and 1 more, rear_0\.npy and 1 more"):
        open_recording(tmp_path)
