"""`torchelev map` from end to end: a small recording in, a map out, and what is said when that fails."""

import cv2
import numpy as np
import plyfile
import pytest

from tests.app.drives import HEIGHT, cut_scan, raise_interrupt, sensor_poses, value_at, write_poses
from torchelev.app.cli import main
from torchelev.io.export import load_npz


@pytest.mark.slow(3)
def test_recording_in_map_out(run, recording, tmp_path):
    code, out, err = run("map", recording, "--size", 8, "--out", "maps/drive")
    assert (code, err) == (0, "")
    saved = load_npz(tmp_path / "maps" / "drive.npz")
    assert value_at(saved, 2.5, 1.5) == pytest.approx(0.4, abs=0.01)
    for x, y in [(-2.5, 1.5), (2.5, -1.5), (1.5, 2.5), (-2.5, -1.5)]:
        assert value_at(saved, x, y) == pytest.approx(0.0, abs=0.01)
    assert saved.center[:2] == pytest.approx([0.75, 0], abs=0.051), "the window follows the sensor"
    assert (tmp_path / "maps" / "drive.png").read_bytes().startswith(b"\x89PNG")
    assert len(plyfile.PlyData.read(tmp_path / "maps" / "drive.ply")["face"].data) > 1000
    for word in (
        "4 of 4",
        "80,000 points",
        "8 x 8 m",
        "coverage",
        "used",
        "ms per scan",
        "drive.npz",
        "--sensor-height",
    ):
        assert word in out


@pytest.mark.slow(2)
def test_defaults_write_map_here(run, recording, tmp_path):
    assert run("map", recording / "scans", "--poses", recording / "poses.txt")[0] == 0
    assert load_npz(tmp_path / "map.npz").layers["elevation"].shape == (200, 200)
    (tmp_path / "folder").mkdir()
    assert run("map", recording, "--size", 2, "--out", "folder")[0] == 0
    assert (tmp_path / "folder" / "map.ply").exists()


@pytest.mark.slow(1)
def test_fixed_window_keeps_its_place(run, recording, tmp_path):
    assert run("map", recording, "--fixed", "--size", 3)[0] == 0
    assert load_npz(tmp_path / "map.npz").center[:2] == pytest.approx([0.375, 0], abs=0.051)
    code, out, _ = run("map", recording, "--size", 0.5)
    assert "--fixed --size 2 to keep it all" in out


@pytest.mark.slow(2)
def test_many_points_above_the_ramp_are_noted(run, recording):
    assert "exclusion ramp" not in run("map", recording, "--size", 4)[1]
    for path in (recording / "scans").iterdir():
        cloud = np.fromfile(path, np.float32).reshape(-1, 4)
        np.concatenate([cloud, cloud + np.float32([0, 0, 5, 0])]).tofile(path)
    assert "note      50 % of the points lie above the exclusion ramp" in run("map", recording, "--size", 4)[1]
    assert "exclusion ramp" not in run("map", recording, "--size", 4, "--levels", 3)[1]


@pytest.mark.slow(2)
def test_robot_height_switches_overlap_clearance_on(run, recording, tmp_path):
    assert run("map", recording, "--size", 8)[0] == 0
    assert load_npz(tmp_path / "map.npz").config["overlap"] is None
    code, out, _ = run("map", recording, "--size", 8, "--sensor-height", HEIGHT)
    saved = load_npz(tmp_path / "map.npz")
    assert saved.config["overlap"] is not None and "overlap" not in out
    assert saved.center[2] == pytest.approx(0, abs=1e-6)
    # A base 4 m below the ground: everything near belongs to another floor.
    code, _, err = run("map", recording, "--size", 4, "--sensor-height", HEIGHT + 4)
    assert code == 3 and "and 0 are left, as other floors: check T_map_base" in err
    assert not np.isfinite(load_npz(tmp_path / "map.npz").layers["elevation"]).any()


@pytest.mark.slow(2)
def test_poses_of_the_base_with_extrinsics(run, recording, tmp_path):
    mount = np.array([[0.0, -1, 0, 0.3], [1, 0, 0, -0.1], [0, 0, 1, 0.5], [0, 0, 0, 1]])
    assert run("map", recording, "--size", 8, "--out", "sensor")[0] == 0
    write_poses(recording / "poses.txt", sensor_poses() @ np.linalg.inv(mount))
    text = " ".join(map(str, mount[:3].ravel()))
    args = ("map", recording, "--size", 8, "--poses-of", "base")
    assert run(*args, "--out", "base", "--extrinsics", text)[0] == 0
    (tmp_path / "mount.yaml").write_text(f"T_base_sensor: {mount.tolist()}")
    assert run(*args, "--out", "yaml", "--extrinsics", "mount.yaml")[0] == 0
    base, sensor = load_npz(tmp_path / "base.npz"), load_npz(tmp_path / "sensor.npz")
    assert base.center[2] == pytest.approx(HEIGHT - 0.5)
    assert value_at(base, 2.5, 1.5) == pytest.approx(value_at(sensor, 2.5, 1.5), abs=1e-3)
    np.testing.assert_array_equal(base.layers["elevation"], load_npz(tmp_path / "yaml.npz").layers["elevation"])


@pytest.mark.slow(1)
def test_depth_images(run, tmp_path):
    folder = tmp_path / "camera"
    folder.mkdir()
    cv2.imwrite(str(folder / "0.png"), np.full((60, 80), 2000, np.uint16))
    # The optical axis straight down from 3 m: x to the right of the image is -y of the map.
    pose = np.array([[0.0, -1, 0, 0], [-1, 0, 0, 0], [0, 0, -1, 3], [0, 0, 0, 1]])
    write_poses(folder / "poses.txt", pose[None])
    (tmp_path / "camera.yaml").write_text("{fx: 60, fy: 60, cx: 39.5, cy: 29.5}")
    code, out, err = run("map", folder, "--intrinsics", tmp_path / "camera.yaml", "--size", 4)
    assert (code, err) == (0, "")
    elevation = load_npz(tmp_path / "map.npz").layers["elevation"]
    assert np.nanmedian(elevation) == pytest.approx(1.0, abs=1e-3)
    i, j = np.nonzero(np.isfinite(elevation))
    assert np.ptp(j) > np.ptp(i), "the image's width lies along y"


def missing_pose(folder):
    write_poses(folder / "poses.txt", sensor_poses()[:-1])
    return "poses.txt: no pose for scan 000003.bin"


def unknown_format(folder):
    (folder / "scans" / "000001.bin").rename(folder / "scans" / "000001.xyz")
    return "000001.xyz: unknown format"


def empty_folder(folder):
    for path in (folder / "scans").iterdir():
        path.unlink()
    return "drive: holds no scan"


def skewed_pose(folder):
    write_poses(folder / "poses.txt", sensor_poses() * [1, 1, 1.2, 1])
    return "poses.txt: line 1"


@pytest.mark.slow(1)
@pytest.mark.parametrize("spoil", [missing_pose, cut_scan, unknown_format, empty_folder, skewed_pose])
def test_a_bad_recording_is_one_line(run, recording, spoil):
    problem = spoil(recording)
    code, _, err = run("map", recording, "--size", 4)
    assert code == 2
    assert err.count("\n") == 1 and err.startswith("Error: ") and problem in err


@pytest.mark.slow(1)
def test_scans_before_a_bad_one_are_kept(run, recording, tmp_path):
    cut_scan(recording)
    code, out, err = run("map", recording, "--size", 4)
    assert code == 2 and "kept the map of 2 of 4 scans" in err
    assert np.isfinite(load_npz(tmp_path / "map.partial.npz").layers["elevation"]).any()
    assert not (tmp_path / "map.npz").exists()  # which may hold an earlier, whole map


@pytest.mark.slow(1)
def test_poses_that_contradict_each_other_are_warned_of(run, recording):
    """Every other scan is a metre higher than its pose says."""
    poses = np.loadtxt(recording / "poses.txt")
    poses[1::2, 11 if poses.shape[1] == 12 else 3] += 1.0
    np.savetxt(recording / "poses.txt", poses)
    code, _, err = run("map", recording, "--size", 4)
    assert code == 0 and "of the points contradict the map; check that poses belong to their scans" in err


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--poses", "gone.txt"], "gone.txt: no such pose file"),
        (["--config", "gone.yaml"], "gone.yaml: cannot be read"),
        (["--config", "unknown.yaml"], "unknown.yaml: config.sensor.rang"),
        (["--config", "body.yaml", "--sensor-height", "1"], "config.sensor.body: the body box turns"),
        (["--config", "links.yaml"], "config.sensor.body: recordings hold no poses of links; give one box"),
        (["--config", "list.yaml"], "list.yaml: expected settings grouped by stage"),
        (["--config", "broken.yaml"], "broken.yaml: cannot be read as YAML"),
        (["--resolution", "-1"], "resolution and size must be positive"),
        (["--size", "nan"], "resolution and size must be positive"),
        (["--size", "2000"], "a map of 400,000,000 cells is too large"),
        (["--out", "list.yaml/map"], "--out list.yaml/map: cannot create the folder list.yaml"),
        (["--device", "abacus"], "--device abacus"),
        (["--dt", "-1"], "--dt: must be"),
        (["--poses-of", "base"], "give --extrinsics"),
        (["--extrinsics", "1 2 3"], "1 2 3: holds 3 numbers"),
        (["--extrinsics", "gone.yaml"], "gone.yaml: neither numbers nor a file"),
        (["--extrinsics", "2 0 0 0 0 2 0 0 0 0 2 0"], "not a rotation matrix"),
        (["--extrinsics", "1 0 0 0 0 1 0 0 0 0 1 0", "--sensor-height", "1"], "--sensor-height"),
    ],
)
def test_bad_options_are_one_line(run, recording, tmp_path, options, problem):
    (tmp_path / "unknown.yaml").write_text("sensor: {rang: 3}")
    (tmp_path / "body.yaml").write_text("sensor: {body: {}}")
    shape = "{link: base, center: [0, 0, 0], half_lengths: [1, 1, 1]}"
    (tmp_path / "links.yaml").write_text(f"sensor: {{body: {{boxes: [{shape}]}}}}")
    (tmp_path / "list.yaml").write_text("[1, 2]")
    (tmp_path / "broken.yaml").write_text("{grid: [")
    code, out, err = run("map", recording, *options)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1 and problem in err


@pytest.mark.slow(1)
def test_ctrl_c_keeps_what_was_mapped(run, recording, tmp_path, at_scan):
    at_scan(2, raise_interrupt)
    code, out, err = run("map", recording, "--size", 8)
    assert code == 130
    assert "interrupted: kept the map of 2 of 4 scans" in err and "map.npz" in out
    saved = load_npz(tmp_path / "map.npz")
    assert value_at(saved, 2.5, 1.5) == pytest.approx(0.4, abs=0.01)
    assert saved.center[0] == pytest.approx(0.25, abs=0.051)


def test_ctrl_c_before_the_first_scan(run, recording, tmp_path, at_scan):
    at_scan(0, raise_interrupt)
    code, out, err = run("map", recording)
    assert (code, out) == (130, "") and "nothing was mapped yet" in err
    assert not (tmp_path / "map.npz").exists()


@pytest.mark.slow(1)
def test_a_wrong_frame_is_pointed_out(run, recording, tmp_path):
    flat = np.zeros((3000, 4), np.float32)
    flat[:, :3] = [0, 0, -HEIGHT] + np.random.default_rng(0).uniform(-3, 3, (3000, 3)) * [1, 1, 0]
    for path in (recording / "scans").iterdir():
        flat.tofile(path)
    poses = sensor_poses()
    poses[:, :3, :3] = poses[:, :3, :3] @ np.diag([1.0, -1, -1])  # upside down: the ground is above the sensor
    write_poses(recording / "poses.txt", poses)
    code, out, err = run("map", recording, "--size", 8)
    assert code == 3 and "overhang 12,000" in out
    assert "the sensor is mounted upside down, which T_map_sensor does not say" in err


@pytest.mark.slow(5)
@pytest.mark.parametrize("suffix", [".bin", ".npy", ".ply"])
@pytest.mark.parametrize("poses_too", [False, True])
def test_millimetres_are_told_to_be_units(run, recording, suffix, poses_too):
    for path in (recording / "scans").iterdir():
        points = np.fromfile(path, np.float32).reshape(-1, 4) * [1000, 1000, 1000, 1]
        path.unlink()
        if suffix == ".bin":
            points.astype(np.float32).tofile(path)
        elif suffix == ".npy":
            np.save(path.with_suffix(suffix), points)
        else:
            vertices = np.array([tuple(p) for p in points[:, :3]], dtype=[(axis, "f4") for axis in "xyz"])
            plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")]).write(path.with_suffix(suffix))
    if poses_too:
        poses = sensor_poses()
        poses[:, :3, 3] *= 1000
        write_poses(recording / "poses.txt", poses)
    code, out, err = run("map", recording, "--size", 8)
    assert code == 3 and "0 used (0.0 %); rejected: range 80,000" in out
    assert err.startswith("warning: points: the median distance is ") and "as of millimetres: check units" in err
    assert err.count("\n") == 2 and "\nError: the map is empty" in err, "the cause is told, not its consequences"


@pytest.mark.slow(3)
def test_a_second_map_in_the_recordings_folder_takes_the_same_scans(run, recording, tmp_path, monkeypatch):
    monkeypatch.chdir(recording)
    for scans in (recording / "scans", recording):
        for _ in range(2):
            code, out, err = run("map", ".", "--size", 4)
            assert code == 0 and "4 of 4" in out, err
        for path in scans.glob("*.bin"):  # the second time round, beside the maps
            path.rename(recording / path.name)


@pytest.mark.slow(1)
def test_the_folder_scans_wins(run, recording):
    np.save(recording / "other.npy", np.zeros((5, 3)))
    (recording / "more").mkdir()
    np.save(recording / "more" / "other.npy", np.zeros((5, 3)))
    code, out, err = run("map", recording, "--size", 4)
    assert code == 0 and "4 of 4, 80,000 points" in out, err


@pytest.mark.slow(2)
def test_maps_of_depth_images_beside_them(run, tmp_path):
    cv2.imwrite(str(tmp_path / "0.png"), np.full((60, 80), 2000, np.uint16))
    write_poses(tmp_path / "poses.txt", np.array([[0.0, -1, 0, 0], [-1, 0, 0, 0], [0, 0, -1, 3], [0, 0, 0, 1]])[None])
    (tmp_path / "camera.yaml").write_text("{fx: 60, fy: 60, cx: 39.5, cy: 29.5}")
    for _ in range(2):
        code, out, err = run("map", ".", "--intrinsics", "camera.yaml", "--size", 4)
        assert code == 0 and "1 of 1" in out, err


def test_a_dangling_link_is_no_gap(run, recording):
    path = recording / "scans" / "000001.bin"
    path.unlink()
    path.symlink_to("gone.bin")
    poses = sensor_poses()[[0, 2, 3]]  # as many as files that can be read
    write_poses(recording / "poses.txt", poses)
    code, _, err = run("map", recording)
    assert code == 2 and "000001.bin: a link to a file that does not exist" in err


@pytest.mark.slow(1)
def test_what_was_mapped_before_any_error_is_kept(run, recording, tmp_path, at_scan):
    def fail():
        raise MemoryError("no memory")

    at_scan(2, fail)
    with pytest.raises(MemoryError):
        main(["map", str(recording), "--size", "4"], standalone_mode=False)
    assert np.isfinite(load_npz(tmp_path / "map.partial.npz").layers["elevation"]).any()


@pytest.mark.slow(2)
def test_layouts_by_option(run, recording, tmp_path):
    for path in (recording / "scans").iterdir():
        points = np.fromfile(path, np.float32).reshape(-1, 4)
        np.column_stack([points, np.arange(len(points)) % 32]).astype(np.float32).tofile(path)
    code, _, err = run("map", recording, "--size", 8)
    assert code == 2 and "000000.bin: does not look like KITTI's" in err and "nothing was mapped yet" in err
    assert run("map", recording, "--size", 8, "--bin-layout", "float32x5")[0] == 0
    assert value_at(load_npz(tmp_path / "map.npz"), 2.5, 1.5) == pytest.approx(0.4, abs=0.01)


def recording_of(folder, clouds):
    """A folder of clouds (N, 3) and level poses 1 m above the ground."""
    folder.mkdir()
    for k, points in enumerate(clouds):
        np.save(folder / f"{k:06d}.npy", points.astype(np.float32))
    np.savetxt(folder / "poses.txt", [np.append(np.eye(4)[:3].ravel()[:11], 1.0) for _ in clouds])
    return folder


def flat(number, distance=3.0):
    xy = np.random.default_rng(0).uniform(-1, 1, (number, 2)) * distance
    return np.column_stack([xy, np.full(number, -1.0)])


@pytest.mark.slow(1)
@pytest.mark.parametrize(
    "cloud, words",
    [
        (flat(500) + [400.0, 0, 0], "the map is empty: 0 of 1,000 points were used, most were rejected as 'range'"),
        (np.full((500, 3), np.nan), "the map is empty: 0 of 1,000 points"),
        (np.vstack([flat(3), flat(497) + [400.0, 0, 0]]), "the map is nearly empty: 6 of 1,000 points were used"),
    ],
)
def test_an_empty_map_has_an_exit_code_of_its_own(run, tmp_path, cloud, words):
    code, out, err = run("map", recording_of(tmp_path / "drive", [cloud, cloud]))
    assert code == 3 and "wrote" in out and words in err.splitlines()[-1] and err.splitlines()[-1].startswith("Error: ")


@pytest.mark.slow(1)
def test_a_map_of_a_fraction_of_the_points_is_none_of_these(run, tmp_path):
    cloud = np.vstack([flat(30), flat(970) + [400.0, 0, 0]])
    assert run("map", recording_of(tmp_path / "drive", [cloud, cloud]))[0] == 0


@pytest.mark.slow(1)
def test_warnings_are_one_line_each(run, tmp_path, at_scan):
    """Of the library, once for each text, without a line of source."""
    import warnings

    for number in range(2):
        at_scan(number, lambda: warnings.warn("updates took\nlong", RuntimeWarning, stacklevel=1))
    cloud = flat(500)
    cloud[::7], cloud[3::7] = np.inf, -np.inf
    code, _, err = run("map", recording_of(tmp_path / "drive", [cloud] * 3))
    assert code == 0 and err.splitlines() == ["warning: updates took long"]


@pytest.mark.slow(1)
def test_a_full_disk_while_a_bag_is_closed_keeps_the_map(run, tmp_path, monkeypatch):
    """SQLite says so by an error of its own."""
    import sqlite3

    from rosbags.rosbag2 import Writer

    def close(self):
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(Writer, "close", close)
    code, _, err = run("map", recording_of(tmp_path / "drive", [flat(500)] * 2), "--grid-map", "grown.db3")
    assert code == 2 and "grown.db3: cannot be written (database or disk is full)" in err
    assert (tmp_path / "map.partial.npz").exists()
