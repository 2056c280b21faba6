"""Pose files of both formats, rounded ones, and every way a line can be wrong."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchelev.io import RecordingError, read_poses


@pytest.fixture
def poses():
    rng = np.random.default_rng(1)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = Rotation.random(5, random_state=2).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(5, 3)) * 1e5
    return poses


def write_kitti(path, poses, digits=17):
    np.savetxt(path, poses[:, :3].reshape(-1, 12), fmt=f"%.{digits}g" if digits > 3 else f"%.{digits}f")


def write_tum(path, poses, times):
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    np.savetxt(path, np.column_stack([times, poses[:, :3, 3], quaternions]), header="t x y z qx qy qz qw")


def test_kitti_round_trip(tmp_path, poses):
    write_kitti(tmp_path / "poses.txt", poses)
    read = read_poses(tmp_path / "poses.txt")
    assert read.times is None and read.T_map_sensor.dtype == np.float64
    np.testing.assert_allclose(read.T_map_sensor, poses, atol=1e-10)


def test_tum_round_trip(tmp_path, poses):
    times = 1.7e9 + np.arange(5) * 0.1
    write_tum(tmp_path / "poses.tum", poses, times)
    read = read_poses(tmp_path / "poses.tum")
    np.testing.assert_allclose(read.T_map_sensor, poses, atol=1e-9)
    np.testing.assert_allclose(read.times, times, atol=1e-6)


def test_tum_quaternion_order_by_hand(tmp_path):
    half = np.sqrt(0.5)
    (tmp_path / "poses.txt").write_text(f"# a quarter turn to the left\n\n0 1 2 3 0 0 {half} {half}\n")
    pose = read_poses(tmp_path / "poses.txt").T_map_sensor[0]
    np.testing.assert_allclose(pose @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)


def test_rounded_rotations_become_rotations(tmp_path, poses):
    write_kitti(tmp_path / "poses.txt", poses, digits=3)
    rotations = read_poses(tmp_path / "poses.txt").T_map_sensor[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (5, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(rotations, poses[:, :3, :3], atol=2e-3)


GOOD = "1 0 0 0 0 1 0 0 0 0 1 0\n"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (GOOD + "# note\n" + "1 0 0 0 0 1.1 0 0 0 0 1 0\n", "line 3: the 3x3 part is not a rotation"),
        (GOOD + "1 0 0 0 0 1 0 0 0 0 -1 0\n", "line 2: the 3x3 part is not a rotation"),
        ("0 0 0 0 0 0 0 0 0 0 0 0\n", "line 1: the 3x3 part is not a rotation"),
        ("\n" + GOOD + "1 0 0 0 0 1 0 0 0 0 1\n", "line 3 holds 11 numbers"),
        (GOOD + "0 0 0 0 0 0 0 1\n", "line 2 holds 8 numbers, the lines before it 12"),
        (GOOD + GOOD.replace("1", "one"), "line 2 holds more than numbers"),
        (GOOD + GOOD.replace("1", "nan"), "line 2 holds NaN"),
        ("0 0 0 0 0 0 0 0\n", "line 1: the quaternion"),
        ("0 0 0 0 0 0 0.5 0.5\n", "line 1: the quaternion"),
        ("# nothing\n", "holds no pose"),
    ],
)
def test_refuses_with_the_line_number(tmp_path, text, problem):
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(RecordingError, match=problem) as caught:
        read_poses(tmp_path / "poses.txt")
    assert str(tmp_path / "poses.txt") in str(caught.value)


def test_refuses_what_is_no_text(tmp_path):
    (tmp_path / "poses.txt").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(RecordingError, match="is not a text file"):
        read_poses(tmp_path / "poses.txt")
    with pytest.raises(RecordingError, match="no such pose file"):
        read_poses(tmp_path / "gone.txt")


@pytest.mark.parametrize("columns", [13, 16, 17, 9, 8])
def test_an_index_whole_matrices_and_a_header(tmp_path, columns):
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = range(5)
    tum = np.column_stack([0.1 * np.arange(5), poses[:, :3, 3], np.tile([0, 0, 0, 1], (5, 1))])
    rows = {8: tum, 9: tum, 13: poses[:, :3].reshape(5, 12)}.get(columns, poses.reshape(5, 16))
    if columns in (9, 13, 17):
        rows = np.column_stack([3 + np.arange(5), rows])
    header = "num t x y z qx qy qz qw\n" if columns == 9 else "t,x,y,z,qx,qy,qz,qw\n" if columns == 8 else ""
    (tmp_path / "p.txt").write_text(header + "\n".join(" ".join(map(str, row)) for row in rows))
    np.testing.assert_allclose(read_poses(tmp_path / "p.txt").T_map_sensor, poses)


def test_thirteen_columns_whose_first_does_not_count(tmp_path):
    (tmp_path / "p.txt").write_text("0.5 1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(RecordingError, match="the first must count the poses"):
        read_poses(tmp_path / "p.txt")
