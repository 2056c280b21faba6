"""Times of points in files take the motion out of a scan."""

import numpy as np
import plyfile
import pytest
from pypcd4 import PointCloud

from torchelev.io import open_recording

SPEED, START, PERIOD = 2.0, 1.7e9, 0.1
OFFSETS = np.linspace(0, 0.0999, 200)
WALL = 7.0  # [m] ahead of the start


def seen(k):
    """Return points on a wall across the path, each as seen from where the sensor was at its time."""
    ahead = WALL - SPEED * (PERIOD * k + OFFSETS)
    return np.stack([ahead, np.linspace(-1, 1, 200), np.zeros(200)], -1).astype(np.float32)


def structured(k, kind="f4", times=OFFSETS, name="t"):
    array = np.zeros(200, [("x", "f4"), ("y", "f4"), ("z", "f4"), (name, kind)])
    (array["x"], array["y"], array["z"]), array[name] = seen(k).T, times
    return array


def write_pcd(path, k):
    PointCloud.from_points(structured(k).view("f4").reshape(-1, 4), ("x", "y", "z", "t"), (np.float32,) * 4).save(path)


WRITERS = {
    "a.npy": lambda path, k: np.save(path, structured(k)),
    "ns.npy": lambda path, k: np.save(path, structured(k, "u4", 1e9 * OFFSETS, "offset_time")),
    "absolute.npy": lambda path, k: np.save(path, structured(k, "f8", START + PERIOD * k + OFFSETS, "timestamp")),
    "columns.npy": lambda path, k: np.save(path, np.column_stack([seen(k), OFFSETS]).astype(np.float32)),
    "beside.npz": lambda path, k: np.savez(path, points=seen(k), times=OFFSETS),
    "a.ply": lambda path, k: plyfile.PlyData([plyfile.PlyElement.describe(structured(k), "vertex")]).write(path),
    "a.pcd": write_pcd,
}


def write(folder, writer, suffix):
    for k in range(4):
        writer(folder / f"{k:06}{suffix}", k)
    rows = (f"{START + PERIOD * k} {SPEED * PERIOD * k} 0 0 0 0 0 1\n" for k in range(4))
    (folder / "poses.txt").write_text("".join(rows))


@pytest.mark.parametrize("name", WRITERS)
def test_a_wall_is_flat_in_the_map(tmp_path, name):
    write(tmp_path, WRITERS[name], f".{name.split('.')[1]}")
    recording = open_recording(tmp_path)
    for frame in recording:
        np.testing.assert_allclose(frame.points[:, 0] + frame.T_map_sensor[0, 3], WALL, atol=1e-3)
    assert not recording.notes


def test_a_sensor_on_a_base_moves_with_it(tmp_path):
    write(tmp_path, WRITERS["a.npy"], ".npy")
    mount = np.eye(4)
    mount[0, 3] = 0.5
    for frame in open_recording(tmp_path).apply_mount(mount)[1:]:
        np.testing.assert_allclose(frame.points[:, 0] + frame.T_map_sensor[0, 3], WALL + 0.5, atol=1e-3)


DRAWN = np.random.default_rng(0).uniform(0, 1, 200)


@pytest.mark.parametrize("column", [DRAWN, 0.1 * DRAWN, np.repeat(np.arange(50.0), 4)])
def test_intensity_and_ring_are_no_times(tmp_path, column):
    write(tmp_path, lambda path, k: np.save(path, np.column_stack([seen(k), column])), ".npy")
    recording = open_recording(tmp_path)
    np.testing.assert_array_equal(recording[1].points, seen(1))
    assert not recording.notes


def test_times_that_are_none_of_a_scan_are_named_once(tmp_path):
    write(tmp_path, lambda path, k: np.save(path, structured(k, "f8", 5e8 + OFFSETS)), ".npy")
    recording = open_recording(tmp_path)
    np.testing.assert_array_equal([frame.points for frame in recording][1], seen(1))
    (note,) = recording.notes
    assert "field t run from 500000000" in note and "not used" in note and recording.notes[note] == 4


def test_poses_without_times_are_named_and_dt_is_the_cure(tmp_path):
    write(tmp_path, WRITERS["a.npy"], ".npy")
    rows = (f"1 0 0 {SPEED * PERIOD * k} 0 1 0 0 0 0 1 0\n" for k in range(4))
    (tmp_path / "poses.txt").write_text("".join(rows))
    recording = open_recording(tmp_path)
    assert len(recording[1].points) == 200
    assert "give poses as TUM, with times, or --dt" in next(iter(recording.notes))
    frame = open_recording(tmp_path, dt=PERIOD)[1]
    np.testing.assert_allclose(frame.points[:, 0] + frame.T_map_sensor[0, 3], WALL, atol=1e-3)
