"""A bag with clouds and no poses, through the command line."""

import numpy as np
import pytest
import torch
from click.testing import CliRunner

pytest.importorskip("kiss_icp")

from benchmarks.quality.odometry.bags import CLOUDS, IMU, START, write_drive
from benchmarks.quality.odometry.drive import T_BASE_LIDAR, Drive
from tests.io.odometry.test_track import turning
from torchelev.app.cli import main
from torchelev.io.bags import Bag, BagRequest, open_bag
from torchelev.io.poses import read_poses
from torchelev.sim import Lidar

NUM = 20
DRIVE = Drive(lidar=Lidar(rings=32, azimuths=400, fov_low_deg=-25.0, fov_high_deg=15.0, max_range=50.0), distance=12.0)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("bag") / "drive.mcap"
    write_drive(path, DRIVE, NUM)
    return path


@pytest.mark.slow(5)
def test_a_bag_without_poses_is_mapped_and_its_poses_are_kept(bag, tmp_path):
    words = ["map", str(bag), "--odometry", "kiss-icp", "--imu", IMU, "--save-poses", str(tmp_path / "poses.txt")]
    done = CliRunner().invoke(main, [*words, "--out", str(tmp_path / "map")])
    assert done.exit_code == 0, done.output
    assert f"{CLOUDS} in odom, around base_link" in done.output
    poses = read_poses(tmp_path / "poses.txt")
    stamps = np.array([DRIVE.scan(k).stamp for k in range(NUM)])
    np.testing.assert_allclose(poses.times - START, stamps, atol=1e-6)
    truth = DRIVE.lidar_at(torch.from_numpy(stamps)).numpy()
    steps = np.linalg.inv(truth[5]) @ truth, np.linalg.inv(poses.T_map_sensor[5]) @ poses.T_map_sensor
    assert np.linalg.norm((steps[0] - steps[1])[:, :3, 3], axis=1).max() < 0.4
    up = truth[5, 2, :3] @ poses.T_map_sensor[5, 2, :3]  # both in the lidar's frame
    assert np.degrees(np.arccos(np.clip(up, -1, 1))) < 3.0


@pytest.mark.slow(4)
def test_poses_of_a_turning_robot_are_those_of_the_stamps_and_hold_its_scans_still(tmp_path):
    drive = turning(Drive(lidar=DRIVE.lidar, distance=5.0))
    write_drive(tmp_path / "turn.mcap", drive, NUM)
    with Bag(tmp_path / "turn.mcap") as opened:
        scans = open_bag(opened, BagRequest(odometry="kiss-icp"))
        stamps, poses, _ = scans.odometry_poses()
        frames = [frame for frame in scans if frame is not None]
    truth = drive.lidar_at(torch.from_numpy(stamps - START)).numpy()
    turned = np.linalg.inv(truth[3]) @ truth, np.linalg.inv(poses[3]) @ poses
    off = np.swapaxes(turned[0][:, :3, :3], 1, 2) @ turned[1][:, :3, :3]
    assert np.degrees(np.arccos(np.clip((np.trace(off, axis1=1, axis2=2) - 1) / 2, -1, 1))).mean() < 0.6
    # What one beam sees at its time is what the robot sees from the stamp's pose: points lie on the true ground.
    T, points = truth[10], frames[10].points[np.isfinite(frames[10].points).all(1)]
    placed = torch.from_numpy(points @ T[:3, :3].T + T[:3, 3])
    high = (drive.height(placed[:, :2]) - placed[:, 2]).abs()[np.linalg.norm(points[:, :2], axis=1) < 6.0]
    assert high.median() < 0.03


@pytest.mark.slow(3)
def test_the_base_is_what_is_fixed_to_the_lidar(bag):
    with Bag(bag) as opened:
        scans = open_bag(opened, BagRequest(odometry="kiss-icp"))
        frame = next(frame for frame in scans if frame is not None)
    assert (scans.map_frame, scans.base_frame, scans.has_base) == ("odom", "base_link", True)
    mounted = np.linalg.inv(frame.T_map_base) @ frame.T_map_sensor
    np.testing.assert_allclose(mounted, T_BASE_LIDAR.numpy(), atol=1e-6)


@pytest.mark.slow(1)
def test_bag_proposes_odometry_where_there_are_clouds_and_no_poses(bag):
    text = CliRunner().invoke(main, ["bag", str(bag)]).output
    assert f"--points {CLOUDS} --odometry kiss-icp --imu {IMU}" in text


@pytest.mark.slow(1)
@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--imu", IMU], "--imu: only with --odometry"),
        (["--odometry", "kiss-icp", "--imu", CLOUDS], f"--imu {CLOUDS} is sensor_msgs/msg/PointCloud2"),
        (["--odometry", "kiss-icp", "--poses", "/odom"], "not in the bag"),
    ],
)
def test_options_that_contradict_each_other_are_refused(bag, words, reason):
    done = CliRunner().invoke(main, ["map", str(bag), *words])
    assert done.exit_code == 2 and reason in done.output


def test_a_folder_refuses_odometry(tmp_path):
    (tmp_path / "000000.bin").write_bytes(bytes(16))
    done = CliRunner().invoke(main, ["map", str(tmp_path), "--odometry", "kiss-icp"])
    assert done.exit_code == 2 and "--odometry: for bags only" in done.output
