"""A run over a recording, and where the robot's base is."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.helpers import small_map
from torchelev.io import Frame, MappingRun, base_poses


def random_poses(count, seed=0):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(seed).normal(size=(count, 3))
    return poses


def test_the_base_by_the_sensors_mount():
    base, mount = random_poses(5), random_poses(1, seed=1)[0]
    found = base_poses(base @ mount, mount, None)
    np.testing.assert_allclose(found, base, atol=1e-12)
    assert (found[:, 3] == [0, 0, 0, 1]).all()


@pytest.mark.parametrize("height", [None, 1.2])
def test_the_base_below_the_sensor(height):
    sensor = random_poses(3)
    found = base_poses(sensor, None, height)
    np.testing.assert_array_equal(found[:, :3, :3], np.tile(np.eye(3), (3, 1, 1)))
    np.testing.assert_array_equal(found[:, :3, 3], sensor[:, :3, 3] - [0, 0, height or 0])


def test_a_run_counts_points_and_follows_the_base():
    emap = small_map()
    run, pose = MappingRun(emap), np.eye(4)
    pose[:3, 3] = [2.0, 1.0, 1.0]
    run.center_on(pose[:3, 3])
    assert run.num_scans == 0 and emap.center[0, :2].tolist() == pytest.approx([2, 1], abs=0.11)
    points = np.array([[0.1, 0.2, -1.0], [0.3, 0.2, -1.0], [np.nan] * 3], np.float32)
    run.add(Frame(points, pose, 0.0, "0.npy"), pose)
    assert (run.num_scans, run.num_points, run.counts["points_used"]) == (1, 3, 2)
    assert run.sensor_xy[0].tolist() == [2.0, 1.0] and len(run.update_ms) == 1
    assert run.sensor_xy[0].base is None, "nothing else of a scan stays in memory"
    pose = pose.copy()
    pose[0, 3] += 1.0
    run.add(Frame(points, pose, 0.1, "1.npy"), None)
    assert run.counts["points_used"] > 0 and emap.center[0, 0].item() == pytest.approx(2, abs=0.11)
