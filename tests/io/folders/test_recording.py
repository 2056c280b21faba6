"""Which scan gets which pose, and what is said where one does not."""

import cv2
import numpy as np
import pytest

from torchelev.io import RecordingError, open_recording


def write_scans(folder, names, suffix=".npy"):
    folder.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        np.save(folder / f"{name}.npy", np.full((4, 3), k, np.float32))
        (folder / f"{name}.npy").rename(folder / f"{name}{suffix}")


def write_kitti(path, xs):
    path.write_text("".join(f"1 0 0 {x} 0 1 0 0 0 0 1 0\n" for x in xs))


def write_tum(path, times):
    path.write_text("".join(f"{t} {k} 0 0 0 0 0 1\n" for k, t in enumerate(times)))


def test_natural_order_and_default_dt(tmp_path):
    write_scans(tmp_path / "run" / "scans", ["scan_1", "scan_2", "scan_10"])
    write_kitti(tmp_path / "run" / "poses.txt", [1, 2, 10])
    recording = open_recording(tmp_path / "run")
    assert [frame.name for frame in recording] == ["scan_1.npy", "scan_2.npy", "scan_10.npy"]
    assert [frame.T_map_sensor[0, 3] for frame in recording] == [1, 2, 10]
    assert [frame.dt for frame in recording] == [0, 0.1, 0.1]
    assert recording[2].points.tolist() == [[2.0] * 3] * 4
    assert recording.note == "" and len(recording[1:]) == 2 and recording[-1].name == "scan_10.npy"


def test_reads_a_scan_only_when_asked(tmp_path):
    write_scans(tmp_path, ["0", "1"])
    write_kitti(tmp_path / "poses.txt", [0, 1])
    (tmp_path / "1.npy").write_bytes(b"broken")
    recording = open_recording(tmp_path)
    assert recording[0].name == "0.npy"
    with pytest.raises(RecordingError, match=r"1\.npy"):
        recording[1]


def test_numbered_scans_index_a_longer_pose_file(tmp_path):
    write_scans(tmp_path, ["000002", "000005"])
    write_kitti(tmp_path / "poses.txt", range(8))
    recording = open_recording(tmp_path)
    assert recording.T_map_sensor[:, 0, 3].tolist() == [2, 5]
    for same in (recording, recording[:1], recording.apply_mount(np.eye(4))):
        assert same.note.endswith("8 poses for 2 scans; each scan takes that of its number: "
                                  "000002.npy takes line 3, 000005.npy line 6")  # fmt: skip


def test_scans_named_by_time_take_the_nearest_pose(tmp_path):
    write_scans(tmp_path, ["1700000000.105000", "1700000000.500000"])
    write_tum(tmp_path / "groundtruth.txt", 1.7e9 + np.arange(10) * 0.1)
    recording = open_recording(tmp_path)
    assert recording.T_map_sensor[:, 0, 3].tolist() == [1, 5]
    np.testing.assert_allclose(recording.dt, [0, 0.4], atol=1e-6)
    np.testing.assert_allclose(open_recording(tmp_path, dt=0.2).dt, [0, 0.2])


def test_time_in_nanoseconds(tmp_path):
    write_scans(tmp_path, [1700000000_100000000, 1700000000_300000000])
    write_tum(tmp_path / "poses.txt", 1.7e9 + np.arange(5) * 0.1)
    assert open_recording(tmp_path).T_map_sensor[:, 0, 3].tolist() == [1, 3]


def test_index_names_are_no_times(tmp_path):
    write_scans(tmp_path, ["000000", "000001", "000002"])
    write_tum(tmp_path / "poses.txt", [0, 0.5, 1.0])
    assert open_recording(tmp_path).T_map_sensor[:, 0, 3].tolist() == [0, 1, 2]


@pytest.mark.parametrize(
    ("names", "poses", "problem"),
    [
        (["a", "b", "c"], [0, 1], r"poses\.txt: no pose for scan c\.npy: 2 poses for 3 scans"),
        (["a", "b"], [0, 1, 2], r"poses\.txt: 3 poses for 2 scans"),
        (["1", "7"], [0, 1, 2], r"poses\.txt: 3 poses for 2 scans"),
    ],
)
def test_refuses_counts_that_differ(tmp_path, names, poses, problem):
    write_scans(tmp_path, names)
    write_kitti(tmp_path / "poses.txt", poses)
    with pytest.raises(RecordingError, match=problem):
        open_recording(tmp_path)


def test_refuses_a_gap_in_time_and_time_that_runs_backwards(tmp_path):
    write_scans(tmp_path, ["10.0", "10.5"])
    write_tum(tmp_path / "poses.txt", [10.0, 10.4])
    with pytest.raises(RecordingError, match=r"no pose for scan 10\.5\.npy: the nearest is 0\.100 s away"):
        open_recording(tmp_path)
    write_scans(tmp_path / "back", ["a", "b"])
    write_tum(tmp_path / "back" / "poses.txt", [1, 0])
    with pytest.raises(RecordingError, match=r"scan b\.npy is older"):
        open_recording(tmp_path / "back")


def test_refuses_a_folder_without_poses(tmp_path):
    write_scans(tmp_path, ["a"])
    with pytest.raises(RecordingError, match="no pose file"):
        open_recording(tmp_path)


@pytest.fixture
def depth_folder(tmp_path):
    depth = np.full((6, 8), 2000, np.uint16)
    depth[0, 0] = 0
    cv2.imwrite(str(tmp_path / "0.png"), depth)
    write_kitti(tmp_path / "poses.txt", [0])
    (tmp_path / "camera.txt").write_text("4 4 4 3")
    return tmp_path


def test_depth_images_become_points(depth_folder):
    points = open_recording(depth_folder, intrinsics=depth_folder / "camera.txt")[0].points
    assert points.shape == (48, 3) and np.isnan(points[0]).all()
    np.testing.assert_allclose(points[3 * 8 + 4], [0, 0, 2], atol=1e-6)
    np.testing.assert_allclose(points[3 * 8 + 6], [1, 0, 2], atol=1e-6)
    np.testing.assert_allclose(points[5 * 8 + 4], [0, 1, 2], atol=1e-6)


def test_depth_images_and_intrinsics_come_together(depth_folder):
    with pytest.raises(RecordingError, match=r"0\.png: depth images need the camera's intrinsics"):
        open_recording(depth_folder)
    (depth_folder / "camera.txt").write_text("600 600 320 240")
    with pytest.raises(RecordingError, match=r"0\.png: the intrinsics' cx 320"):
        open_recording(depth_folder, intrinsics=depth_folder / "camera.txt")[0]
    write_scans(depth_folder / "clouds", ["a"])
    with pytest.raises(RecordingError, match=r"a\.npy: holds a point cloud .*, not depth"):
        open_recording(depth_folder / "clouds", intrinsics=depth_folder / "camera.txt")


def test_unit_and_axes_of_depth_images_can_be_given(depth_folder):
    given = {"intrinsics": depth_folder / "camera.txt", "depth_scale": 0.01, "depth_axes": "forward"}
    np.testing.assert_allclose(open_recording(depth_folder, **given)[0].points[3 * 8 + 6], [20, -10, 0], atol=1e-5)
    (depth_folder / "0.png").unlink()
    np.save(depth_folder / "0.npy", np.full((6, 8), 2000.0, np.float32))
    given["depth_scale"] = 0.001
    np.testing.assert_allclose(open_recording(depth_folder, **given)[0].points[3 * 8 + 6], [2, -1, 0], atol=1e-5)


@pytest.mark.parametrize("option", [{"depth_scale": 0.001}, {"depth_axes": "forward"}])
def test_unit_and_axes_need_depth_images(tmp_path, option):
    write_scans(tmp_path, ["a"])
    write_kitti(tmp_path / "poses.txt", [0])
    with pytest.raises(ValueError, match="--depth-.*: is for depth images only.*give their camera with --intrinsics"):
        open_recording(tmp_path, **option)
