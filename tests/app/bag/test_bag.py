"""`torchelev bag` and `torchelev map` with a bag, from end to end."""

import numpy as np
import pytest

from tests.app.drives import raise_interrupt
from tests.helpers import without
from tests.io.bags.synthetic import COVARIANCE, FORMATS, SCANS, Writer, drive, write_drive
from torchelev.io.export import load_npz


@pytest.fixture
def bag(tmp_path):
    return write_drive(tmp_path)


@pytest.mark.slow(2)
@pytest.mark.parametrize("kind", FORMATS)
def test_a_bag_in_a_map_out(run, tmp_path, kind):
    code, out, err = run("map", write_drive(tmp_path, kind), "--size", 6, "--resolution", 0.05, "--out", "maps/drive")
    assert (code, err) == (0, "")
    saved = load_npz(tmp_path / "maps" / "drive.npz")
    elevation = saved.layers["elevation"]
    x = saved.center[0] + (np.arange(len(elevation)) + 0.5 - len(elevation) / 2) * 0.05
    near = np.isfinite(elevation) & (np.abs(np.arange(elevation.shape[1]) - elevation.shape[1] // 2) < 10)
    for low, high, z in ((0.5, 0.9, 0.0), (1.1, 1.25, 0.1), (1.4, 1.55, 0.2)):
        found = elevation[near & ((x > low) & (x < high))[:, None]]
        assert len(found) > 5 and abs(np.median(found) - z) < 0.005
    for word in (f"{SCANS} of {SCANS}", "/lidar/points in odom, around base_link", "drive.npz"):
        assert word in out
    assert "overlap" not in out  # the base is known


@pytest.mark.slow(1)
def test_topics_frames_and_poses_can_be_given(run, bag, tmp_path):
    options = ("--points", "/lidar/points", "--depth", "/camera/depth/image_raw", "--map-frame", "odom")
    code, out, err = run("map", bag, *options, "--base-frame", "base_link", "--poses", "/odom", "--fixed", "--size", 6)
    assert (code, err) == (0, "") and f"{2 * SCANS} of {2 * SCANS}" in out
    variance = load_npz(tmp_path / "map.npz").layers["variance"]
    assert np.nanmin(variance) > 0.9 * COVARIANCE[2, 2]


@pytest.mark.slow(1)
@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_a_recording_is_not_written_over(run, tmp_path, kind):
    bag = write_drive(tmp_path, kind)
    files = sorted(bag.iterdir()) if bag.is_dir() else [bag]
    before = [file.read_bytes() for file in files]
    for name, ending in (("--grid-map", ".bag"), ("--video", ".gif")):
        code, _, err = run("map", bag, name, bag / f"map{ending}" if bag.is_dir() else bag)
        assert code == 2 and f"{name}: must not be written over the recording" in err
    assert [file.read_bytes() for file in files] == before


def test_a_time_between_maps_needs_a_recording_of_them(run, bag):
    code, _, err = run("map", bag, "--every", 1)
    assert code == 2 and "give --grid-map or --video" in err


def test_the_listing_has_topics_frames_and_the_command(run, bag):
    code, out, err = run("bag", bag)
    assert (code, err) == (0, "")
    for words in (
        "/lidar/points sensor_msgs/msg/PointCloud2 6", "/odom nav_msgs/msg/Odometry 61 50.0 odom",
        "odom └─ base_link (61 poses) ├─ camera (static) └─ lidar (static)",
        f"torchelev map {bag} --points /lidar/points --map-frame odom --base-frame base_link",
    ):  # fmt: skip
        assert words in " ".join(out.split())


@pytest.mark.slow(2)
def test_the_proposed_command_runs(run, bag):
    _, out, _ = run("bag", bag)
    command = out.strip().splitlines()[-1].split()
    assert command[:2] == ["torchelev", "map"]
    assert run(*command[1:], "--size", 2)[0] == 0


def test_a_bag_that_cannot_be_mapped_says_what_is_missing(run, tmp_path):
    writer = Writer(tmp_path / "drive", "mcap")
    for topic in ("/a", "/b"):
        writer.cloud(drive().clouds[0], topic, time="timestamp")
    writer.close()
    code, out, _ = run("bag", tmp_path / "drive")
    assert code == 0 and "transforms none it cannot be mapped" in " ".join(out.split())
    assert "the transforms have no frame lidar; frames are none" in out


@pytest.mark.slow(1)
def test_scans_that_are_left_out_are_counted(run, tmp_path):
    writer = Writer(tmp_path / "drive", "mcap")
    for stamp, T in zip(drive().stamps, drive().bases, strict=True):
        writer.transform(stamp, "odom", "lidar", T)
    writer.cloud(drive().clouds[0], order="xy", time="timestamp")
    writer.cloud(drive().clouds[1], time="timestamp")
    writer.close()
    code, out, err = run("map", tmp_path / "drive", "--size", 2)
    assert code == 0 and "1 of 2" in out
    assert err == "warning: 1 of 2 scans were left out: the cloud has no field z; it has x, y, timestamp\n"


REFUSED = {
    "options of files": (("--dt", 0.1), "--dt: for folders of files only"),
    "poses of": (("--poses-of", "base"), "--poses-of: for folders of files only"),
    "no such topic": (("--points", "/x"), "--points /x is not in the bag; such topics are /lidar/points"),
    "no such frame": (("--map-frame", "map"), "the transforms have no frame map; frames are base_link, camera, lidar"),
}


@pytest.mark.slow(1)
@pytest.mark.parametrize(("options", "words"), REFUSED.values(), ids=REFUSED)
def test_wrong_options_are_refused_in_one_line(run, bag, tmp_path, options, words):
    code, _, err = run("map", bag, *options)
    assert code == 2 and words in err and len(err.splitlines()) == 1
    assert not (tmp_path / "map.npz").exists()


def test_options_of_bags_are_refused_for_folders(run, recording):
    code, _, err = run("map", recording, "--points", "/x", "--map-frame", "odom")
    assert code == 2 and "--points, --map-frame: for bags only" in err


@pytest.mark.parametrize("command", ["map", "bag"])
def test_without_rosbags_the_extra_is_named(run, bag, command, monkeypatch):
    without(monkeypatch, "rosbags.highlevel")
    code, _, err = run(command, bag)
    assert code == 2 and "pip install 'torchelev[bags]'" in err


@pytest.mark.slow(1)
def test_ctrl_c_keeps_the_map(run, bag, tmp_path, at_scan):
    at_scan(3, raise_interrupt)
    code, _, err = run("map", bag, "--size", 4)
    assert code == 130 and f"kept the map of 3 of {SCANS} scans" in err and (tmp_path / "map.npz").exists()


@pytest.mark.slow(1)
def test_the_growing_map_is_recorded(run, bag, tmp_path):
    from torchelev.io import read_grid_maps

    code, out, err = run("map", bag, "--size", 4, "--grid-map", "grown.mcap", "--every", 0.2)
    assert (code, err) == (0, "") and "recorded  3 maps in grown.mcap" in out
    maps = list(read_grid_maps(tmp_path / "grown.mcap"))
    known = [int(np.isfinite(one.layers["elevation"]).sum()) for one in maps]
    assert len(maps) == 3 and known[0] < known[2] and maps[0].frame == "odom"
    assert [one.stamp - maps[0].stamp for one in maps] == pytest.approx([0.0, 0.2, 0.4], abs=1e-6)
    last = load_npz(tmp_path / "map.npz")
    assert last.layers["elevation"].shape == maps[-1].layers["elevation"].shape


@pytest.mark.slow(1)
def test_the_growing_map_of_a_folder_is_recorded(run, recording, tmp_path):
    code, out, _ = run("map", recording, "--size", 4, "--grid-map", "grown.bag", "--every", 0)
    assert code == 0 and "recorded  4 maps in grown.bag" in out


@pytest.mark.slow(1)
@pytest.mark.parametrize(("options", "words"), [
    (("--every", -1), "--every: must not be negative"),
    (("--grid-map", "x.png"), "path: must be a bag's, got x.png"),
])  # fmt: skip
def test_a_wrong_bag_for_maps_is_refused(run, bag, tmp_path, options, words):
    code, _, err = run("map", bag, *options)
    assert code == 2 and words in err and not (tmp_path / "map.npz").exists()
