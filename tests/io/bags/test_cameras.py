"""Calibration, unit and axes of depth images: found in the bag, or named by options."""

import pytest
import torch

from tests.io.bags.synthetic import T_BASE_CAMERA, Writer, drive, write_drive
from tests.io.bags.test_recording import map_bag
from torchelev.io import RecordingError
from torchelev.io.bags import BagRequest

REALSENSE, DEPTH = "/device_0/sensor_0/Depth_0/image/data", "/front/depth/image"


def write(
    folder, topic=DEPTH, info="/front/depth/camera_info", unit=1e-3, options=(), kind="mcap", mount=T_BASE_CAMERA
):
    writer = Writer(folder / "drive", kind)
    writer.transform(drive().stamps[0], "base_link", "camera", mount.numpy(), is_static=True)
    for stamp, T in zip(drive().stamps, drive().bases, strict=True):
        writer.transform(stamp, "odom", "base_link", T)
    writer.camera_info(drive().stamps[0], info)
    for name, text in options:
        message = writer.make("std_msgs/msg/String", data=text)
        writer.write(name, "std_msgs/msg/String", drive().stamps[0], message)
    for scan, image in drive().depths:
        writer.depth(scan.stamp, image * 1e-3 / unit, "16UC1", topic)
    writer.close()
    return folder / "drive"


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """The heights by depth images whose calibration, unit and axes are as usual."""
    path = write_drive(tmp_path_factory.mktemp("plain"))
    return map_bag(path, BagRequest(depths=["/camera/depth/image_raw"]))[0].layer("elevation")


def assert_right(emap, expected):
    error = (emap.layer("elevation") - expected).abs()
    error = error[error.isfinite()]
    assert len(error) > 300 and float((error < 2e-3).float().mean()) > 0.98


@pytest.mark.slow(1)
@pytest.mark.parametrize("name", ["option/Depth_Units/value", "option/Depth Units/value"])
def test_the_unit_that_librealsense_recorded_is_used(tmp_path, name, expected):
    options = [("/device_0/sensor_1/" + name, "0.01"), ("/device_0/sensor_0/" + name, "0.0001")]
    path = write(tmp_path, REALSENSE, "/device_0/sensor_0/Depth_0/info/camera_info", 1e-4, options, "sqlite3")
    emap, _, recording = map_bag(path, BagRequest(depths=[REALSENSE]))
    assert recording.warnings == []
    assert_right(emap, expected)


def test_a_given_unit_comes_before_the_recorded_one(tmp_path, expected):
    options = [("/device_0/sensor_0/option/Depth_Units/value", "0.001")]
    path = write(tmp_path, REALSENSE, "/device_0/sensor_0/Depth_0/info/camera_info", 1e-4, options)
    emap, *_ = map_bag(path, BagRequest(depths=[REALSENSE], depth_scale=1e-4))
    assert_right(emap, expected)


def test_depths_in_another_unit_are_doubted_in_one_line(tmp_path):
    _, frames, recording = map_bag(write(tmp_path, unit=1e-5), BagRequest(depths=[DEPTH]))
    (line,) = [line for line in recording.warnings if "--depth-scale" in line]
    assert len(frames) > 1 and line.startswith(f"{DEPTH}: half of the depths are beyond ")


def test_a_unit_that_is_none_is_refused(tmp_path):
    options = [("/device_0/sensor_0/option/Depth_Units/value", "unknown")]
    path = write(tmp_path, REALSENSE, "/device_0/sensor_0/Depth_0/info/camera_info", 1e-4, options)
    with pytest.raises(RecordingError, match="Depth_Units/value says 'unknown', which is no unit of depth; give"):
        map_bag(path, BagRequest(depths=[REALSENSE]))
    with pytest.raises(ValueError, match="--depth-scale: must be positive and finite, got -1"):
        map_bag(path, BagRequest(depths=[REALSENSE], depth_scale=-1.0))


def test_a_camera_info_elsewhere_is_named(tmp_path, expected):
    path = write(tmp_path, info="/calibration/left")
    with pytest.raises(RecordingError, match="no camera_info beside it; name one with --camera-info; topics of Camera"):
        map_bag(path, BagRequest(depths=[DEPTH]))
    for wrong, words in ((["/nowhere"], "--camera-info /nowhere is not in the bag; such topics are /calibration/left"),
                         (["/a", "/b"], "2 topics of CameraInfo are given for 1 topics")):  # fmt: skip
        with pytest.raises(RecordingError, match=words):
            map_bag(path, BagRequest(depths=[DEPTH], camera_infos=wrong))
    emap, _, recording = map_bag(path, BagRequest(depths=[DEPTH], camera_infos=["/calibration/left"]))
    assert recording.warnings == []
    assert_right(emap, expected)


def test_a_camera_in_a_body_frame_is_said_and_read_with_its_axes(tmp_path, expected):
    optical = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]).double()
    path = write(tmp_path, mount=T_BASE_CAMERA @ torch.linalg.inv(optical))
    _, _, recording = map_bag(path, BagRequest(depths=[DEPTH]))
    assert (
        f"{DEPTH}: a camera with the axes of camera looks up: if its x axis points forward, give --depth-axes forward"
        in (recording.warnings)
    )
    emap, _, recording = map_bag(path, BagRequest(depths=[DEPTH], depth_axes="forward"))
    assert recording.warnings == []
    assert_right(emap, expected)


def test_reasons_of_one_kind_are_one_line(tmp_path):
    writer = Writer(tmp_path / "drive", "mcap")
    for stamp, T in zip(drive().stamps, drive().bases, strict=True):
        writer.transform(stamp, "odom", "lidar", T)
    for number, scan in enumerate(drive().clouds):
        cut = scan._replace(points=scan.points[: 100 + number], times=None)
        if number < 4:  # each with another number of bytes
            write_message = writer.write

            def shorten(topic, name, stamp, message, write_message=write_message):
                message.data = message.data[:-5]
                write_message(topic, name, stamp, message)

            writer.write = shorten
            writer.cloud(cut)
            writer.write = write_message
        else:
            writer.cloud(cut)
    writer.close()
    _, frames, recording = map_bag(tmp_path / "drive")
    assert len(frames) == 2
    (line,) = recording.warnings
    assert line.startswith("4 of 6 scans were left out: the sizes of the cloud contradict each other: 1 x 100 points")
