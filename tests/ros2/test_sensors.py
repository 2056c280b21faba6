"""Messages as points: motion within a scan, depth images, periods; and messages that are of no use."""

from types import SimpleNamespace as Stub

import numpy as np
import pytest

from torchelev.io.bags.messages.cloud import CloudError
from torchelev.ros2.sensors import Reading, Sensor


def header(stamp=100.0, frame="lidar"):
    return Stub(stamp=Stub(sec=int(stamp), nanosec=round(stamp % 1 * 1e9)), frame_id=frame)


def timed_cloud(xyz, times):
    """A PointCloud2 whose points have a time [s] from its stamp."""
    data = np.zeros(len(xyz), np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<f4")]))
    for name, values in zip("xyzt", (*np.asarray(xyz).T, times), strict=True):
        data[name] = values
    fields = [Stub(name=name, offset=4 * k, datatype=7, count=1) for k, name in enumerate("xyzt")]
    layout = {"height": 1, "width": len(xyz), "point_step": 16, "row_step": 16 * len(xyz), "is_bigendian": False}
    return Stub(header=header(), fields=fields, data=data.tobytes(), **layout)


def driving(times, speed=(2.0, 0.0, 0.0), turn=1.0, far=0.0):
    """Poses (M, 4, 4) of a sensor that drives and turns."""
    T = np.tile(np.eye(4), (len(times), 1, 1))
    cosine, sine = np.cos(turn * times), np.sin(turn * times)
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = cosine, -sine, sine, cosine
    T[:, :3, 3] = np.multiply.outer(times, speed) + [far, 0, 0]
    return T


@pytest.mark.parametrize("far", [0.0, 1e5])
@pytest.mark.parametrize("first", [0.0, -0.1, -0.05])
def test_motion_within_a_scan_is_taken_out(far, first):
    wall = np.random.default_rng(0).uniform(-10, 10, (500, 3))  # in the map, as seen from the stamp
    times = np.linspace(first, first + 0.1, 500)
    T = np.linalg.inv(driving(times, far=far)) @ driving(np.zeros(1), far=far)
    seen = np.einsum("nij,nj->ni", T[:, :3, :3], wall) + T[:, :3, 3]
    reading = Reading(Sensor("lidar"), timed_cloud(seen, times))
    points = reading.points(True, lambda at: driving(at, far=far))
    assert reading.find_span(True) == pytest.approx((min(first, 0), max(first + 0.1, 0)), abs=1e-6)
    np.testing.assert_allclose(points, wall, atol=1e-3)
    assert abs(seen - wall).max() > 0.1
    np.testing.assert_allclose(reading.points(False, None), seen, atol=1e-5)
    assert reading.find_span(False) == (0.0, 0.0)


def test_points_without_a_pose_are_unknown_and_too_few_poses_are_said():
    times = np.linspace(0.0, 0.1, 101)
    reading = Reading(Sensor("lidar"), timed_cloud(np.ones((101, 3)), times))

    def until(end):
        return lambda at: np.where((at <= end)[:, None, None], driving(at), np.nan)

    points = reading.points(True, until(0.05))
    assert np.isnan(points[52:]).all() and np.isfinite(points[:46]).all()
    for end in (0.0, -1.0):
        with pytest.raises(CloudError, match="tf has too few poses from 0 to 0.1 s from its stamp"):
            reading.points(True, until(end))


def test_depth_images_wait_for_their_camera():
    depth = np.full((2, 3), 2000, "<u2")
    image = Stub(header=header(), height=2, width=3, encoding="16UC1", is_bigendian=0, step=6, data=depth.tobytes())
    sensor = Sensor("/depth/image_rect_raw", is_depth=True)
    with pytest.raises(CloudError, match="no CameraInfo was received; see the parameter camera_infos"):
        Reading(sensor, image).points(True, driving)
    assert Reading(sensor, image).find_span(True) == (0.0, 0.0)
    sensor.camera = Stub(height=2, width=3, k=np.array([1.0, 0, 1, 0, 1, 0, 0, 0, 1]), p=np.zeros(12), d=())
    points = Reading(sensor, image).points(True, driving)
    assert points[:3].tolist() == [[-2, 0, 2], [0, 0, 2], [2, 0, 2]]
    assert Reading(Sensor("d", True, 1e-4, sensor.camera), image).cloud.points[0, 2] == pytest.approx(0.2)


def test_the_period_of_a_topic_is_known_after_some_messages():
    sensor = Sensor("lidar")
    for k in range(6):
        assert (sensor.period is None) == (k < 4)
        sensor.note(1.7e9 + 0.1 * k + (0.05 if k == 4 else 0))
    assert sensor.period == pytest.approx(0.1, abs=1e-3)
    sensor.note(5.0)  # a clock jumped
    assert sensor.period is None


def test_a_message_that_contradicts_itself_is_read_when_it_is_needed():
    reading = Reading(Sensor("lidar"), Stub(header=header(), fields=[], point_step=4, data=b""))
    assert reading.find_span(True) == (0.0, 0.0)
    with pytest.raises(CloudError, match="no field x, y, z"):
        reading.points(True, driving)
