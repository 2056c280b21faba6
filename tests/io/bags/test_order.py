"""Messages of several sensors come in the order of their stamps, and few are held in memory."""

from types import SimpleNamespace

import numpy as np
import pytest

from tests.io.bags.synthetic import DEPTH, T_BASE_CAMERA, Writer, drive
from tests.io.bags.test_recording import map_bag
from torchelev.io.bags import Bag, BagRequest, open_bag
from torchelev.io.bags.bag import Message
from torchelev.io.bags.order import _MAX_HELD, order_by_stamp


def message(topic, stamp):
    header = SimpleNamespace(stamp=SimpleNamespace(sec=int(stamp), nanosec=round(stamp % 1 * 1e9)))
    return Message(topic, 0.0, SimpleNamespace(header=header))


def ordered(recorded, topics="ab"):
    """Topic and stamp of each message, and the largest number of messages that were read and not yet given."""
    read, given, waiting = 0, [], [0]

    def count():
        nonlocal read
        for topic, stamp in recorded:
            read += 1
            yield message(topic, stamp)

    for one in order_by_stamp(count(), list(topics)):
        given.append((one.topic, round(one.data.header.stamp.sec + one.data.header.stamp.nanosec * 1e-9, 3)))
        waiting.append(read - len(given))
    return given, max(waiting)


def test_a_sensor_that_arrives_late_is_put_in_its_place():
    late = [("b", 0.1 * k + 0.05) for k in range(50)]
    soon = [("a", 0.1 * k) for k in range(50)]
    recorded = sorted([(t, (n, t)) for n, t in soon] + [(t + 0.34, (n, t)) for n, t in late])
    given, waiting = ordered([one for _, one in recorded])
    assert [stamp for _, stamp in given] == pytest.approx(sorted(stamp for _, stamp in soon + late))
    assert waiting <= 5


def test_one_sensor_does_not_wait():
    assert ordered([("a", 0.1 * k) for k in range(9)], "a")[1] == 0


def test_equal_stamps_keep_the_order_of_their_recording():
    assert ordered([("b", 1.0), ("a", 1.0), ("a", 2.0), ("b", 2.0)])[0] == [("b", 1), ("a", 1), ("a", 2), ("b", 2)]


@pytest.mark.parametrize("period, most", [(0.1, 11), (0.001, _MAX_HELD)])
def test_a_silent_sensor_holds_up_the_others_for_a_bounded_time(period, most):
    given, waiting = ordered([("b", 0.0), *(("a", period * (k + 1)) for k in range(2000))])
    assert len(given) == 2001 and waiting <= most


def test_a_wrong_stamp_does_not_end_the_order():
    recorded = [("a", 0.0), ("b", 1e9), ("a", 0.1), ("b", 0.15), ("b", 0.35), ("a", 0.2), ("a", 0.3), ("a", 0.4)]
    given, _ = ordered(recorded)
    assert [stamp for _, stamp in given] == [0.0, 0.1, 0.15, 0.2, 0.3, 0.35, 0.4, 1e9]


@pytest.mark.slow(1)
def test_scans_of_a_bag_are_fused_in_the_order_of_their_stamps(tmp_path):
    writer = Writer(tmp_path / "drive", "mcap")
    for stamp, T in zip(drive().stamps, drive().bases, strict=True):
        writer.transform(stamp, "odom", "lidar", T)
        writer.transform(stamp, "odom", "camera", T @ T_BASE_CAMERA.numpy())
    writer.camera_info(drive().stamps[0])
    write = writer.write
    writer.write = lambda topic, name, stamp, one: write(topic, name, stamp + 0.28 * (topic == DEPTH), one)
    for scan in drive().clouds:
        writer.cloud(scan, time="timestamp")
    for scan, image in drive().depths:
        writer.depth(scan.stamp, image)
    writer.close()
    request = BagRequest(clouds=["/lidar/points"], depths=[DEPTH], map_frame="odom", base_frame="lidar")
    _, frames, recording = map_bag(tmp_path / "drive", request)
    stamps = np.array([frame.stamp for frame in frames])
    assert (np.diff(stamps) > 0).all() and not recording.warnings
    assert sum(frame.dt for frame in frames) == pytest.approx(stamps[-1] - stamps[0])


def test_a_scan_that_comes_too_late_is_said(tmp_path):
    writer, (first, *scans) = Writer(tmp_path / "drive", "mcap"), drive().clouds
    for stamp, T in zip(drive().stamps, drive().bases, strict=True):
        writer.transform(stamp, "odom", "lidar", T)
    for scan in (*scans, first):
        writer.cloud(scan, time="timestamp")
    writer.close()
    with Bag(tmp_path / "drive") as bag:
        recording = open_bag(bag)
        messages = list(bag.read(["/lidar/points"]))
        bag.read = lambda topics: [*messages[1:], messages[0]]
        frames = list(recording)
    assert frames[-1].dt == 0.0
    late = "some scans are older than those before them, and are fused with dt = 0"
    assert recording.warnings == [f"/lidar/points: {late}"]
