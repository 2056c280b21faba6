"""Variances by which drivers say "not measured" do not reach the map."""

from types import SimpleNamespace

import numpy as np
import pytest

from torchelev.io.bags.covariance import PoseCovariances


def odometry(covariance, stamp=0.0):
    header = SimpleNamespace(stamp=SimpleNamespace(sec=int(stamp), nanosec=round(stamp % 1 * 1e9)))
    return SimpleNamespace(header=header, pose=SimpleNamespace(covariance=np.asarray(covariance, float).ravel()))


UNKNOWN = {
    "gazebo_ros_diff_drive": ([1e-5, 1e-5, 1e12, 1e12, 1e12, 1e-3], "1e+12 for z, roll, pitch", [0, 1, 5]),
    "diff_drive_controller": ([1e-3, 1e-3, 1e6, 1e6, 1e6, 1e3], "1e+06 for z, roll, pitch, yaw", [0, 1]),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_what_was_not_measured_is_left_out_and_named(name):
    diagonal, words, measured = UNKNOWN[name]
    kept = PoseCovariances("/odom")
    value = np.diag(diagonal)
    value[0, 2] = value[2, 0] = 5.0
    kept.add(odometry(value))
    expected = np.where(np.isin(np.arange(6), measured), diagonal, 0.0)
    np.testing.assert_allclose(kept.of_sensor(0.0, np.zeros(3)), np.diag(expected))
    assert kept.notes == [f"/odom gives variances up to {words}: not measured, and taken as 0"]


def test_what_was_measured_is_not_named():
    kept = PoseCovariances("/odom")
    kept.add(odometry(np.diag([400.0, 400.0, 1.0, 0.1, 0.1, 3.0])))  # after a long drive
    assert kept.notes == [] and kept.of_sensor(0.0, np.zeros(3))[0, 0] == 400.0


@pytest.mark.parametrize("value", [np.zeros(36), np.full(36, np.nan), np.diag([-1.0, 0, 0, 0, 0, 0])])
def test_what_is_not_filled_in_is_not_used(value):
    kept = PoseCovariances()
    kept.add(odometry(value))
    assert kept.of_sensor(0.0, np.zeros(3)) is None and kept.notes == []


def test_the_nearest_in_time_is_found_whatever_the_order():
    kept = PoseCovariances()
    for stamp in (3.0, 1.0, 2.0):
        kept.add(odometry(stamp * np.eye(6) / 10, stamp))
    for time, stamp in ((-5.0, 1.0), (1.4, 1.0), (1.6, 2.0), (2.9, 3.0), (9.0, 3.0)):
        assert kept.of_sensor(time, np.zeros(3))[0, 0] == pytest.approx(stamp / 10)
