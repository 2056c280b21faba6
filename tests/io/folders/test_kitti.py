"""Poses of KITTI's left camera and the calibration beside them."""

import numpy as np
import pytest

from torchelev.io import RecordingError, open_recording

T_CAMERA_LIDAR = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.3], [1, 0, 0, -0.2], [0, 0, 0, 1.0]])


def lidar_poses(step=1.0):
    """Return a lidar that drives ahead in a curve."""
    poses = np.tile(np.eye(4), (6, 1, 1))
    for k, yaw in enumerate(0.1 * np.arange(6)):
        poses[k, :2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        poses[k, :2, 3] = step * k, 0.05 * step * k * k
    return poses


def write(folder, poses, calibration=None):
    (folder / "velodyne").mkdir()
    for k in range(len(poses)):
        np.hstack([np.full((40, 3), k), np.ones((40, 1))]).astype(np.float32).tofile(folder / f"velodyne/{k:06}.bin")
    (folder / "poses.txt").write_text("\n".join(" ".join(map(str, T[:3].ravel())) for T in poses))
    if calibration is not None:
        (folder / "calib.txt").write_text(calibration)


TR = "P0: " + "0 " * 12 + "\nTr: " + " ".join(map(str, T_CAMERA_LIDAR[:3].ravel())) + "\n"
CAMERA_POSES = T_CAMERA_LIDAR @ lidar_poses() @ np.linalg.inv(T_CAMERA_LIDAR)


def test_poses_of_the_camera_become_those_of_the_lidar(tmp_path):
    write(tmp_path, CAMERA_POSES, TR)
    recording = open_recording(tmp_path)
    np.testing.assert_allclose(recording.T_map_sensor, lidar_poses(), atol=1e-6)
    assert "converted to the lidar's by" in recording.note and "calib.txt" in recording.note


def test_poses_of_the_lidar_stay_beside_a_calibration(tmp_path):
    write(tmp_path, lidar_poses(), TR)
    recording = open_recording(tmp_path)
    np.testing.assert_allclose(recording.T_map_sensor, lidar_poses(), atol=1e-6)
    assert recording.note == ""


def test_a_map_whose_z_is_up_stays_so(tmp_path):
    write(tmp_path, lidar_poses() @ np.linalg.inv(T_CAMERA_LIDAR), TR)
    np.testing.assert_allclose(open_recording(tmp_path).T_map_sensor, lidar_poses(), atol=1e-6)


def test_without_a_calibration_the_poses_are_doubted(tmp_path):
    write(tmp_path, CAMERA_POSES)
    assert "put calib.txt, with the line Tr" in open_recording(tmp_path).note


def test_a_calibration_without_the_lidar_is_refused(tmp_path):
    write(tmp_path, CAMERA_POSES, "P0: 1 2 3\n")
    with pytest.raises(RecordingError, match=r"calib\.txt: does not hold the lidar's pose"):
        open_recording(tmp_path)


def test_a_path_too_short_to_decide_is_named(tmp_path):
    write(tmp_path, T_CAMERA_LIDAR @ lidar_poses(0.01) @ np.linalg.inv(T_CAMERA_LIDAR), TR)
    assert "too short" in open_recording(tmp_path).note


@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_a_path_of_half_a_metre_shows_its_direction(tmp_path, yaw):
    straight = np.tile(np.eye(4), (6, 1, 1))
    straight[:, 0, 3] = 0.1 * np.arange(6)
    straight[:, :2, :3] = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ straight[:, :2, :3]
    straight[:, :2, 3] = straight[:, 0:1, 3] * [np.cos(yaw), np.sin(yaw)]
    write(tmp_path, T_CAMERA_LIDAR @ straight @ np.linalg.inv(T_CAMERA_LIDAR), TR)
    np.testing.assert_allclose(open_recording(tmp_path).T_map_sensor, straight, atol=1e-6)


def test_a_short_straight_path_is_not_taken_silently(tmp_path):
    straight = np.tile(np.eye(4), (6, 1, 1))
    straight[:, 0, 3] = 0.04 * np.arange(6)
    write(tmp_path, T_CAMERA_LIDAR @ straight @ np.linalg.inv(T_CAMERA_LIDAR), TR)
    assert "too short" in open_recording(tmp_path).note


def test_a_sensor_that_stands_at_the_origin_needs_no_calibration(tmp_path):
    write(tmp_path, np.tile(np.eye(4), (6, 1, 1)), TR)
    assert open_recording(tmp_path).note == ""
