"""Poses from clouds: on ground that shows the motion they are right, elsewhere they are refused with the cause."""

import numpy as np
import pytest
import torch

pytest.importorskip("kiss_icp")

from benchmarks.quality.odometry.drive import Drive
from torchelev.io.odometry import OdometryError, Sweep, estimate_track
from torchelev.sim import Lidar

LIDAR = Lidar(rings=32, azimuths=512, fov_low_deg=-25.0, fov_high_deg=15.0, max_range=50.0)
FLAT = dict(relief=0.0, rocks=0, swing=0.0, lidar=LIDAR)
CORRIDOR = ((50.0, 2.0, 2.0, 200.0, 0.2, 2.5), (50.0, -2.0, 2.0, 200.0, 0.2, 2.5), (50.0, 0.0, 3.0, 200.0, 2.0, 0.1))
HALL = (
    (30.0, 0.0, 1.0, 0.2, 24.0, 6.0), (-30.0, 0.0, 1.0, 0.2, 24.0, 6.0), (0.0, 24.0, 1.0, 30.0, 0.2, 6.0),
    (0.0, -24.0, 1.0, 30.0, 0.2, 6.0), (4.0, 3.0, 0.3, 0.5, 0.4, 0.4),
)  # fmt: skip


def sweeps(drive, count, first=0):
    return [Sweep(*drive.scan(k)) for k in range(first, first + count)]


def errors(drive, track):
    """Distances [m] from the true places, in the frame of the first pose."""
    T = drive.lidar_at(torch.from_numpy(track.times)).numpy()
    return np.linalg.norm((np.linalg.inv(T[0]) @ T - track.T_start_sensor)[:, :3, 3], axis=1)


def turning(drive):
    """The same ground, on which the robot turns to and fro on the spot: at a steady rate no time could be told."""
    turned = torch.eye(4, dtype=torch.float64).repeat(len(drive.times), 1, 1)
    angle = 0.4 * torch.sin(2.0 * drive.times)
    turned[:, 0, 0], turned[:, 0, 1], turned[:, 1, 0], turned[:, 1, 1] = (
        angle.cos(), -angle.sin(), angle.sin(), angle.cos(),
    )  # fmt: skip
    drive.__dict__["bases"] = drive.bases[:1] @ turned
    return drive


@pytest.mark.slow(4)
def test_a_drive_over_rough_ground_is_followed():
    drive = Drive(lidar=LIDAR, distance=20.0)
    track = estimate_track(sweeps(drive, 40))
    assert errors(drive, track).max() < 0.35


@pytest.mark.slow(3)
def test_poses_are_those_of_the_middle_of_each_scan():
    drive = turning(Drive(lidar=LIDAR, distance=5.0))
    track = estimate_track(sweeps(drive, 25))
    stamps = np.array([drive.scan(k).stamp for k in range(25)])
    np.testing.assert_allclose(track.stamps, stamps)
    np.testing.assert_allclose(track.times, stamps + 0.05, atol=1e-3)

    def heading(at):  # [rad] from the true poses at `at`, against those that were found
        T = drive.lidar_at(torch.from_numpy(at)).numpy()
        T = np.linalg.inv(T[5]) @ T
        found = np.linalg.inv(track.T_start_sensor[5]) @ track.T_start_sensor
        turn = np.swapaxes(T[:, :3, :3], 1, 2) @ found[:, :3, :3]
        return np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))

    assert heading(track.times).mean() < 0.01 < heading(track.stamps).mean()


@pytest.mark.slow(2)
def test_points_without_return_are_left_out_together_with_their_times():
    drive = Drive(lidar=LIDAR, distance=10.0)
    clean = [Sweep(s.stamp, s.points[k], s.times[k]) for s in sweeps(drive, 5) for k in [np.isfinite(s.points).all(1)]]
    holes = [Sweep(s.stamp, s.points, np.where(np.isfinite(s.points).all(1), s.times, 3.0)) for s in sweeps(drive, 5)]
    one, other = estimate_track(clean), estimate_track(holes)
    np.testing.assert_array_equal(one.times, other.times)
    np.testing.assert_allclose(one.T_start_sensor, other.T_start_sensor, atol=1e-6)


@pytest.mark.slow(2)
@pytest.mark.parametrize("walls", [(), CORRIDOR], ids=["plane", "corridor"])
def test_clouds_that_do_not_show_the_motion_are_refused(walls):
    drive = Drive(**FLAT, walls=walls, distance=20.0)
    with pytest.raises(OdometryError, match="constrain one direction|lost the clouds"):
        estimate_track(sweeps(drive, 40))


@pytest.mark.slow(3)
def test_a_hall_whose_floor_holds_the_odometry_fast_is_refused():
    drive = Drive(**FLAT, walls=HALL, distance=20.0)
    with pytest.raises(OdometryError, match="walls move by"):
        estimate_track(sweeps(drive, 40))


def test_too_few_scans_are_refused_with_the_reason():
    few = Sweep(0.0, np.ones((20, 3), np.float32), None)
    with pytest.raises(OdometryError, match="at least two scans, and 0 can be used; 3 were left out: fewer than 100"):
        estimate_track([few] * 3)
