"""Layouts that files do not state are detected or refused, and options set them."""

import numpy as np
import pytest
from pypcd4 import PointCloud
from scipy.spatial.transform import Rotation

from torchelev.io import FileLayout, RecordingError, open_recording, read_cloud, read_poses


def cloud(seed, num_points=4000):
    """Rings of a lidar 1.2 m above the ground (even seeds), or points in no order: x y z intensity ring time."""
    rng = np.random.default_rng(seed)
    ring, turn = np.arange(num_points) % 32, np.arange(num_points) // 32
    if seed % 2:
        xy = rng.uniform(-20, 20, (num_points, 2))
    else:
        radius, angle = 2 + ring, turn * 0.05
        xy = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    z = -1.2 + rng.normal(0, 0.02, num_points)
    return np.column_stack([xy, z, rng.integers(0, 256, num_points), ring, turn * 1e-3])


@pytest.mark.parametrize("seed", range(10))
def test_kittis_layout_is_taken(tmp_path, seed):
    points = cloud(seed, [4000, 960, 33, 20, 5][seed % 5] * 3)[:, :4]
    points[:, 3] *= [0, 1, 1 / 255][seed % 3]
    points[::7] = [0, np.nan][seed % 2]
    points.astype(np.float32).tofile(tmp_path / "0.bin")
    np.testing.assert_array_equal(read_cloud(tmp_path / "0.bin"), points[:, :3].astype(np.float32))


@pytest.mark.slow(1)
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("layout", ["float32x5", "float32x3", "float32x6", "float64x3", "float64x4", "float64x5"])
def test_other_layouts_are_refused_by_name_and_read_with_the_option(tmp_path, seed, layout):
    dtype, columns = layout.split("x")
    for num_points in (3840, 3841, 500, 200):  # whole numbers of KITTI's points among them
        points = cloud(seed, num_points)[:, : int(columns)].astype(dtype)
        points.tofile(tmp_path / "0.bin")
        with pytest.raises(RecordingError, match=f"{layout}.*--bin-layout"):
            read_cloud(tmp_path / "0.bin")
        read = read_cloud(tmp_path / "0.bin", FileLayout(bin=layout))
        np.testing.assert_array_equal(read, points[:, :3].astype(np.float32))


def test_round_numbers_in_float64(tmp_path):
    np.round(cloud(1)[:, :4] * 4).astype(np.float64).tofile(tmp_path / "0.bin")
    with pytest.raises(RecordingError, match="float64x4"):
        read_cloud(tmp_path / "0.bin")


def test_bytes_that_are_no_coordinates(tmp_path):
    np.random.default_rng(0).integers(0, 256, 16_000, dtype=np.uint8).tofile(tmp_path / "0.bin")
    with pytest.raises(RecordingError, match="not coordinates in metres"):
        read_cloud(tmp_path / "0.bin")


@pytest.mark.parametrize("bad", ["float16x4", "float32x2", "5", "float32"])
def test_refuses_layouts_that_do_not_exist(bad):
    with pytest.raises(ValueError, match="--bin-layout: must be"):
        FileLayout(bin=bad)


MOUNTS = {"lidar": [0, 0, 0], "pitched lidar": [0, 0.5, 0], "optical": [-np.pi / 2, 0, -np.pi / 2]}


def drive(mount, turn, tilt, seed=0, count=60):
    """Quaternions (T, 4) x y z w of a sensor on a robot that turns by `turn` [rad] on ground of `tilt` [rad]."""
    rng = np.random.default_rng(seed)
    yaw = rng.uniform(-3, 3) + np.linspace(0, turn, count)
    sway = tilt * np.sin(np.linspace(0, 9, count)[:, None] + rng.uniform(0, 6, 2))
    return (Rotation.from_euler("ZYX", np.column_stack([yaw, sway])) * Rotation.from_euler("xyz", mount)).as_quat()


def write_tum(path, quaternions, times=None, header=""):
    times = np.arange(len(quaternions)) * 0.1 if times is None else times
    rows = np.column_stack([times, np.zeros((len(quaternions), 3)), quaternions])
    np.savetxt(path, rows, header=header, comments="# " if header else "")


@pytest.mark.slow(2)
@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("turn", [0.0, 0.3, 2.0, 6.0])
@pytest.mark.parametrize("tilt", [0.0, 0.05, 0.25])
def test_quaternions_in_tums_order_are_taken(tmp_path, mount, turn, tilt):
    for seed in range(10):
        quaternions = drive(MOUNTS[mount], turn, tilt, seed)
        write_tum(tmp_path / "poses.txt", quaternions)
        read = read_poses(tmp_path / "poses.txt").T_map_sensor[:, :3, :3]
        np.testing.assert_allclose(read, Rotation.from_quat(quaternions).as_matrix(), atol=1e-9)


@pytest.mark.parametrize("mount, turn", [("lidar", 1.0), ("lidar", 6.0), ("pitched lidar", 3.0), ("optical", 3.0)])
def test_quaternions_as_w_x_y_z_are_refused(tmp_path, mount, turn):
    quaternions = drive(MOUNTS[mount], turn, 0.02)
    write_tum(tmp_path / "poses.txt", np.roll(quaternions, 1, axis=1))
    with pytest.raises(RecordingError, match=r"poses\.txt: read as qx qy qz qw the sensor .* --quaternions wxyz"):
        read_poses(tmp_path / "poses.txt")
    expected = Rotation.from_quat(quaternions).as_matrix()
    read = read_poses(tmp_path / "poses.txt", FileLayout(quaternions="wxyz"))
    np.testing.assert_allclose(read.T_map_sensor[:, :3, :3], expected, atol=1e-9)
    read_poses(tmp_path / "poses.txt", FileLayout(quaternions="xyzw"))  # who says so is believed
    write_tum(tmp_path / "poses.txt", np.roll(quaternions, 1, axis=1), header="t x y z qw qx qy qz")
    np.testing.assert_allclose(read_poses(tmp_path / "poses.txt").T_map_sensor[:, :3, :3], expected, atol=1e-9)


def test_an_identity_as_w_x_y_z_is_refused(tmp_path):
    (tmp_path / "poses.txt").write_text("0 0 0 1 1 0 0 0\n")
    with pytest.raises(RecordingError, match="hangs upside down"):
        read_poses(tmp_path / "poses.txt")


def recording(folder, times):
    for k in range(len(times)):
        np.save(folder / f"{k}.npy", np.zeros((4, 3), np.float32))
    write_tum(folder / "poses.txt", np.tile([0, 0, 0, 1], (len(times), 1)), times)
    return folder


@pytest.mark.parametrize("unit, per_second", [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_times_in_another_unit(tmp_path, unit, per_second):
    folder = recording(tmp_path, np.arange(5) * 0.1 * per_second)
    with pytest.raises(RecordingError, match=r"s between scans \(median\).*--time-unit"):
        open_recording(folder)
    np.testing.assert_allclose(open_recording(folder, layout=FileLayout(time_unit=unit)).dt, [0, *[0.1] * 4])
    assert open_recording(folder, dt=0.2).dt[1] == 0.2
    recording(tmp_path, (1.7e9 + np.arange(5) * 0.1) * per_second)  # since 1970
    np.testing.assert_allclose(open_recording(folder).dt, [0, *[0.1] * 4], atol=1e-6)


def test_times_without_a_step(tmp_path):
    with pytest.raises(RecordingError, match="all poses have the same time"):
        open_recording(recording(tmp_path, [3.0, 3.0, 3.0]))
    recording(tmp_path, [3.0, 3.0, 3.1])  # two sensors
    assert open_recording(tmp_path).dt[1] == 0


def test_pcd_viewpoint(tmp_path):
    points = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    PointCloud.from_xyz_points(points).save(tmp_path / "0.pcd")
    np.testing.assert_array_equal(read_cloud(tmp_path / "0.pcd"), points)
    half = np.sqrt(0.5)
    raw = (tmp_path / "0.pcd").read_bytes()
    line = next(line for line in raw.split(b"\n") if line.startswith(b"VIEWPOINT"))
    (tmp_path / "0.pcd").write_bytes(raw.replace(line, f"VIEWPOINT 1 2 3 {half} 0 0 {half}".encode()))
    with pytest.raises(RecordingError, match="VIEWPOINT 1 2 3 .*--pcd-frame"):
        read_cloud(tmp_path / "0.pcd")
    np.testing.assert_array_equal(read_cloud(tmp_path / "0.pcd", FileLayout(pcd_frame="sensor")), points)
    seen = Rotation.from_quat([0, 0, half, half]).inv().apply(points - [1, 2, 3])
    np.testing.assert_allclose(read_cloud(tmp_path / "0.pcd", FileLayout(pcd_frame="viewpoint")), seen, atol=1e-5)
