"""A bag of any format gives the map of the arrays that went in."""

import numpy as np
import pytest
import torch

from tests.io.bags import synthetic
from tests.io.bags.synthetic import COVARIANCE, DEPTH, FORMATS, ODOM, START, Writer, drive, write_drive
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.frames import deskew
from torchelev.io import MappingRun, RecordingError
from torchelev.io.bags import Bag, BagRequest, open_bag

GRID = GridConfig(resolution=0.05, length_x=6.0, length_y=6.0)


def new_run():
    return MappingRun(ElevationMap(ElevationMapConfig(grid=GRID)))


def map_bag(path, request=None):
    run = new_run()
    with Bag(path) as bag:
        recording = open_bag(bag, request)
        frames = [frame for frame in recording if frame is not None]
        for frame in frames:
            run.add(frame, frame.T_map_base)
        return run.emap, frames, recording


def map_arrays(scans):
    """The map of what was recorded, each cloud moved to its stamp."""
    emap, last = ElevationMap(ElevationMapConfig(grid=GRID)), scans[0].stamp
    for scan in scans:
        points = torch.from_numpy(scan.points)[None]
        if scan.times is not None:
            stamps = torch.from_numpy(drive().stamps - scan.stamp)[None]
            poses = torch.from_numpy(drive().bases)[None] @ synthetic.T_BASE_LIDAR
            points = deskew(points, torch.from_numpy(scan.times)[None], poses, stamps, torch.zeros(1))
        T, base = torch.from_numpy(scan.T_map_sensor)[None], torch.from_numpy(scan.T_map_base)[None]
        emap.update(points, T, base, dt=scan.stamp - last)
        last = scan.stamp
    return emap


def assert_same_map(a, b, share=0.999):
    """To rounding: a point may fall into the next cell."""
    known = a.layer("validity"), b.layer("validity")
    assert float((known[0] == known[1]).float().mean()) >= share
    error = (a.layer("elevation") - b.layer("elevation")).abs()
    error = error[error.isfinite()]
    assert len(error) > 500 and float((error < 1e-4).float().mean()) >= share - 0.005


@pytest.mark.slow(4)
@pytest.mark.parametrize("kind", FORMATS)
def test_all_formats_give_the_map_of_the_arrays(tmp_path, kind):
    emap, frames, recording = map_bag(write_drive(tmp_path, kind))
    assert (recording.map_frame, recording.base_frame, recording.topics) == ("odom", "base_link", ["/lidar/points"])
    assert len(frames) == len(recording) == synthetic.SCANS and not recording.warnings
    for frame, scan in zip(frames, drive().clouds, strict=True):
        np.testing.assert_allclose(frame.T_map_sensor, scan.T_map_sensor, atol=1e-6)
        np.testing.assert_allclose(frame.T_map_base, scan.T_map_base, atol=1e-6)
        assert frame.stamp == pytest.approx(scan.stamp, abs=1e-6)
    assert_same_map(emap, map_arrays(drive().clouds))


LAYOUTS = {
    "float64": dict(dtype="f8"),
    "order": dict(order="zyx"),
    "padding": dict(pad=3),
    "big-endian": dict(bigendian=True, dtype="f8"),
    "organised": dict(rows=synthetic.LIDAR.rings, pad=5),
}


@pytest.mark.slow(3)
@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_every_layout_of_a_cloud_gives_the_same_points(tmp_path, layout):
    _, frames, _ = map_bag(write_drive(tmp_path, depth=False, **layout))
    (tmp_path / "plain").mkdir()
    _, plain, _ = map_bag(write_drive(tmp_path / "plain", depth=False))
    for frame, other in zip(frames, plain, strict=True):
        np.testing.assert_array_equal(frame.points, other.points)


def test_the_motion_within_a_scan_is_taken_out(tmp_path):
    """Points on the ground lie at z = 0 of the map frame, and only then."""
    _, frames, _ = map_bag(write_drive(tmp_path, depth=False))
    for frame, scan in zip(frames, drive().clouds, strict=True):
        moved = (frame.T_map_sensor[:3, :3] @ frame.points.T).T + frame.T_map_sensor[:3, 3]
        skewed = (frame.T_map_sensor[:3, :3] @ scan.points.T).T + frame.T_map_sensor[:3, 3]
        is_wall = np.abs(moved[:, 0] - 1.02) < 2e-3  # the first riser
        assert is_wall.sum() > 20
        assert not (np.abs(skewed[is_wall, 0] - 1.02) < 2e-3).all()


@pytest.mark.slow(2)
def test_clouds_and_depth_images_together_and_the_covariance_of_odometry(tmp_path):
    request = BagRequest(clouds=["/lidar/points"], depths=[DEPTH], poses=ODOM)
    _, frames, _ = map_bag(write_drive(tmp_path), request)
    assert [frame.name for frame in frames] == ["/lidar/points", DEPTH] * synthetic.SCANS
    for frame, (scan, _) in zip(frames[1::2], drive().depths, strict=True):
        np.testing.assert_allclose(frame.T_map_sensor, scan.T_map_sensor, atol=1e-6)
        in_map = (frame.T_map_sensor[:3, :3] @ frame.points.T).T + frame.T_map_sensor[:3, 3]
        truth = synthetic.SCENE.truth(torch.from_numpy(in_map[:, :2]), 0.0).numpy()
        on_top = np.isfinite(in_map).all(1) & (np.abs(in_map[:, 2] - truth) < 1e-3)
        assert on_top.sum() > 100
    r = frames[0].T_map_sensor[:3, 3] - frames[0].T_map_base[:3, 3]
    # d_z of the sensor: that of the base, and the rotations about x and y times the lever.
    expected = COVARIANCE[2, 2] + COVARIANCE[3, 3] * r[1] ** 2 + COVARIANCE[4, 4] * r[0] ** 2
    assert frames[0].pose_covariance[2, 2] == pytest.approx(expected)


@pytest.mark.parametrize("encoding", ["16UC1", "png"])
def test_depth_in_millimetres_and_as_png(tmp_path, encoding):
    writer = Writer(tmp_path / "drive", "mcap")
    (scan, depth), *_ = drive().depths
    for stamp, T in zip(drive().stamps, drive().bases, strict=True):
        writer.transform(stamp, "odom", "camera", T)
    writer.camera_info(scan.stamp)
    topic = DEPTH if encoding == "16UC1" else f"{DEPTH}/compressedDepth"
    writer.depth(scan.stamp, depth, encoding, topic)
    writer.close()
    _, (frame,), _ = map_bag(tmp_path / "drive", BagRequest(depths=[topic]))
    seen = frame.points[:, 2]
    np.testing.assert_allclose(seen[np.isfinite(seen)], depth.ravel()[np.isfinite(seen)], atol=6e-4)
    assert np.isfinite(seen).sum() == (np.nan_to_num(depth) > 0).sum()


def test_a_scan_without_a_pose_is_left_out_and_counted(tmp_path):
    writer = Writer(tmp_path / "drive", "mcap")
    scans = drive().clouds
    for stamp, T in zip(drive().stamps, drive().bases, strict=True):
        if stamp < START + 0.21:
            writer.transform(stamp, "odom", "lidar", T)
    for scan in scans:
        writer.cloud(scan, time="timestamp")
    writer.close()
    _, frames, recording = map_bag(tmp_path / "drive")
    assert 3 <= len(frames) <= 4  # not extrapolated by more than a scan's period
    assert recording.warnings == [f"{6 - len(frames)} of 6 scans were left out: no pose of lidar in odom at that time"]


def bag_of(path, *transforms, topics=("/lidar/points",)):
    """A bag with a scan on each topic, and poses of each (parent, child) of the whole drive."""
    writer = Writer(path, "mcap")
    for parent, child in transforms:
        for stamp, T in zip(drive().stamps, drive().bases, strict=True):
            writer.transform(stamp, parent, child, T)
    for topic in topics:
        writer.cloud(drive().clouds[0], topic, time="timestamp")
    writer.close()
    return path


MISSING = {
    "no transforms": ((), {}, "frames are none; give --poses TOPIC if the bag holds Odometry, or --odometry kiss-icp"),
    "no such frame": ([("odom", "lidar")], dict(map_frame="map"), "have no frame map; frames are lidar, odom"),
    "broken tree": (
        [("odom", "base_link"), ("mast", "lidar")],
        dict(map_frame="odom", base_frame="base_link"),
        "no transform connects odom and lidar: odom is in the tree of odom, lidar in that of mast, and nothing places",
    ),
    "no such topic": (
        [("odom", "lidar")],
        dict(clouds=["/x"]),
        "--points /x is not in the bag; such topics are /lidar",
    ),
    "not a cloud": ([("odom", "lidar")], dict(depths=["/tf"]), "--depth /tf is tf2_msgs/msg/TFMessage"),
    "no poses": ([("odom", "lidar")], dict(poses="/odom"), "--poses /odom is not in the bag; topics of poses are none"),
}


@pytest.mark.slow(1)
@pytest.mark.parametrize(("transforms", "request_", "words"), MISSING.values(), ids=MISSING)
def test_what_is_missing_is_named(tmp_path, transforms, request_, words):
    path = bag_of(tmp_path / "drive", *transforms)
    with pytest.raises(RecordingError) as error:
        map_bag(path, BagRequest(**request_))
    assert words in str(error.value)


def test_several_topics_of_clouds_must_be_chosen(tmp_path):
    path = bag_of(tmp_path / "drive", ("odom", "lidar"), topics=("/a", "/b"))
    with pytest.raises(RecordingError, match="there are 2 topics of clouds: /a, /b; give --points"):
        map_bag(path)
    assert len(map_bag(path, BagRequest(clouds=["/b", "/a"]))[1]) == 2


def test_localisation_above_odometry_and_a_slash_before_names(tmp_path):
    path = bag_of(tmp_path / "drive", ("map", "/odom"), ("odom", "base_footprint"), ("base_footprint", "lidar"))
    _, _, recording = map_bag(path)
    assert (recording.map_frame, recording.base_frame) == ("odom", "base_footprint")
