"""The node in real ROS 2: `make test-ros2`."""

import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from robot import LATCHED, Robot, cells_of, to_cloud
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from tf2_msgs.msg import TFMessage


@pytest.mark.parametrize("name", ["still", "timed", "depth"])
def test_a_bag_through_topics_gives_the_map_of_torchelev_map(make_robot, prepared, name):
    depths = ["-p", "depths:=[/camera/depth/image_raw]", "-p", "clouds:=[unused]"] if name == "depth" else []
    robot = make_robot("", "-p", "reliable:=true", *depths)  # all clouds must arrive
    topic, kind = ("/camera/depth/image_raw", Image) if name == "depth" else ("/lidar/points", PointCloud2)
    robot.clouds[topic] = robot.create_publisher(kind, topic, 10)
    info = robot.create_publisher(CameraInfo, "/camera/depth/camera_info", LATCHED)
    robot.wait(lambda: robot.clouds[topic].get_subscription_count() > 0)
    robot.wait(lambda: name != "depth" or info.get_subscription_count() > 0)
    moving, fixed = (
        robot.create_publisher(TFMessage, "/tf", 100),
        robot.create_publisher(TFMessage, "/tf_static", LATCHED),
    )
    kinds = {"/tf": (TFMessage, moving), "/tf_static": (TFMessage, fixed)}
    kinds["/camera/depth/camera_info"] = (CameraInfo, info)
    clouds = []
    with AnyReader([prepared / name]) as bag:
        for connection, _, raw in bag.messages():
            if connection.topic in kinds:
                type_, publisher = kinds[connection.topic]
                publisher.publish(deserialize_message(raw, type_))
                robot.spin(0.003)
            else:
                clouds.append(deserialize_message(raw, kind))
    robot.spin(0.5)
    for number, cloud in enumerate(clouds):
        robot.send(topic, cloud)
        robot.wait(lambda: robot.count("fused") == number + 1)  # noqa: B023
    stamp = clouds[-1].header.stamp
    robot.heard.pop("points", None)
    robot.wait(lambda: "points" in robot.heard and robot.heard["points"].header.stamp == stamp)
    found = cells_of(robot.heard["points"])
    wanted = np.load(prepared / f"{name}_map.npz", allow_pickle=True)
    i, j = np.nonzero(np.isfinite(wanted["elevation"]))
    corner = wanted["map_corner"][0]
    assert len(found) == len(i) > (300 if name == "depth" else 2000)
    expected = {(a + corner[0], b + corner[1]): wanted["elevation"][a, b] for a, b in zip(i, j, strict=True)}
    assert found.keys() == expected.keys()
    assert max(abs(found[key] - z) for key, z in expected.items()) < 1e-5
    assert robot.heard["points"].header.frame_id == "odom"


def test_outputs_of_flat_ground(make_robot):
    robot = make_robot()
    for k in range(3):
        robot.fuse(1000.0 + 0.1 * k)
    robot.wait(lambda: {"costmap", "height_scan", "status"} <= robot.heard.keys())
    grid = robot.heard["costmap"]
    data = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    assert data.shape == (80, 80) and grid.info.origin.position.x == pytest.approx(-4.0)
    assert (data[20:60, 20:60] == 0).mean() > 0.99 and data[0, 0] == -1
    scan = robot.heard["height_scan"]
    assert scan.layout.dim[0].label == "isaac_lab"
    np.testing.assert_allclose(scan.data, np.zeros(187), atol=0.01)  # 0.5 m over the ground, less the offset of 0.5
    assert robot.heard["status"].level == b"\x00" and robot.heard["status"].message == "nothing looks wrong"


def test_missing_transforms_and_unreadable_clouds_are_counted_and_named(make_robot, tmp_path):
    robot = make_robot()
    robot.fuse(1000.0)
    robot.send_until(lambda: robot.count("without_transform") >= 1, 1000.1, frame="nowhere")
    broken = PointCloud2()
    broken.header.frame_id, broken.header.stamp.sec = "lidar", 1000
    broken.header.stamp.nanosec = 50_000_000
    robot.send_poses(1000.2)
    robot.spin(0.1)
    robot.send("/lidar/points", broken)
    robot.wait(lambda: robot.count("unreadable") >= 1)
    text = Path(robot.log).read_text()
    assert "nowhere" in text and "the cloud has no field x, y, z" in text
    robot.fuse(1000.3)


def test_a_clock_that_jumps_back(make_robot):
    robot = make_robot()
    for stamp in (1000.0, 1000.1, 1000.2):
        robot.fuse(stamp)
    robot.send_until(lambda: robot.count("repeated") >= 1, 1000.2)
    robot.send_until(lambda: robot.count("jumps") == 1, 5.0)
    robot.fuse(5.1)
    robot.fuse(5.2)
    assert "the clock jumped back" in Path(robot.log).read_text()


def test_parameters(make_robot):
    robot = make_robot("", "-p", "map.grid.length_x:=4.0")
    robot.fuse(1000.0)
    assert robot.set(rate_costmap=20.0, layers=["elevation", "variance"]) is None
    assert "must lie in [0, 1000], got -1.0" in robot.set(rate_costmap=-1.0)
    assert "must lie in [0, 1), got 2.0" in robot.set(min_traversability=2.0)
    assert robot.set(layers=["elevaton"]).startswith("layers: must be ")
    assert "read-only" in robot.set(map_frame="map")
    assert robot.set(**{"map.grid.length_x": 3.0}) == "map.grid.length_x: settings of the map need a restart"
    robot.heard.pop("points", None)
    robot.fuse(1000.1)
    robot.wait(lambda: "points" in robot.heard)
    assert [field.name for field in robot.heard["points"].fields] == ["x", "y", "z", "variance"]


def test_a_node_that_dies_loads_its_map(make_robot, tmp_path):
    saved = tmp_path / "saved.safetensors"
    robot = make_robot("", "-p", f"map_file:={saved}", "-p", "load_on_start:=true")
    robot.fuse(1000.0)
    robot.wait(lambda: "points" in robot.heard)
    before = cells_of(robot.heard["points"])
    assert robot.call("save_map") == (True, f"saved {saved}")
    robot.stop(signal.SIGKILL)
    robot.start(robot.log)
    robot.fuse(1000.1, height=5.0)  # above the exclusion ramp: nothing is fused into it
    robot.heard.pop("points", None)
    robot.wait(lambda: "points" in robot.heard)
    after = cells_of(robot.heard["points"])
    assert after.keys() == before.keys()
    assert robot.call("clear_map") == (True, "the map is empty")
    assert robot.set(map_file=str(tmp_path / "none")) is None
    success, text = robot.call("load_map")
    assert not success and text.startswith(str(tmp_path / "none"))


def test_two_robots_in_namespaces(make_robot):
    topics = ["-r", "/lidar/points:=points", "-p", "clouds:=[points]"]
    robots = [make_robot(name, *topics) for name in ("one", "two")]
    for k, robot in enumerate(robots):
        robot.fuse(1000.0, height=-0.8 + 0.1 * k, topic=f"/{('one', 'two')[k]}/points")
    for k, robot in enumerate(robots):
        robot.wait(lambda: "points" in robot.heard)  # noqa: B023
        heights = np.array(list(cells_of(robot.heard["points"]).values()))
        np.testing.assert_allclose(heights, 0.1 * k, atol=0.01)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_in_the_middle_of_its_work(make_robot, how):
    robot = make_robot()
    robot.fuse(1000.0)
    for k in range(5):
        robot.send_poses(1000.1 + 0.1 * k)
        robot.send_cloud(1000.1 + 0.1 * k)
    robot.stop(how)
    text = Path(robot.log).read_text()
    assert "Traceback" not in text, text


def test_stamps_are_those_of_the_clouds_and_bad_ones_are_refused(make_robot):
    robot = make_robot()
    robot.fuse(1700000000.0)
    cloud = to_cloud(np.zeros((100, 3), np.float32) - 1, 0.0, "lidar")
    for sec, nanosec in ((-3, 0), (0, 0)):
        cloud.header.stamp.sec, cloud.header.stamp.nanosec = sec, nanosec
        robot.send("/lidar/points", cloud)
    robot.wait(lambda: robot.count("without_stamp") >= 1)
    robot.send_poses(1700000001.0)
    robot.spin(0.1)
    cloud.header.stamp.sec, cloud.header.stamp.nanosec = 1700000000, 123456789
    robot.send("/lidar/points", cloud)
    robot.wait(lambda: "points" in robot.heard and robot.heard["points"].header.stamp == cloud.header.stamp)


def test_a_node_that_fuses_nothing_says_so(make_robot):
    robot = make_robot()
    robot.wait(lambda: "status" in robot.heard)
    assert robot.heard["status"].level == b"\x01"
    assert robot.heard["status"].message.startswith("/lidar/points: nothing was received")
    robot.send_until(lambda: robot.count("without_transform") >= 1, 1000.0, poses=False, frame="nowhere")
    robot.wait(lambda: "nothing was fused yet" in robot.heard["status"].message)


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["-p", "rate_costmap:=often"], "rate_costmap: must be a number, got 'often'"),
        (["-p", "clouds:=/points"], "clouds: must be a list of names, got '/points'"),
        (["-p", "bas_frame:=x"], "bas_frame: is no parameter"),
        (["-p", "map.grid.resolution:=-1.0"], "grid.resolution: must be a positive number, got -1.0"),
    ],
)
def test_what_ros_gives_wrong_is_refused_in_a_sentence(tmp_path, prepared, library, arguments, words):
    robot = Robot(prepared / "robot.yaml", "", ["-p", library, *arguments])
    done = subprocess.run(robot.command, capture_output=True, text=True, cwd=tmp_path, timeout=30)
    robot.destroy_node()
    assert done.returncode != 0 and words in done.stderr and "Traceback" not in done.stderr


def test_numbers_and_settings_of_the_map_may_come_from_ros(make_robot):
    robot = make_robot("", "-p", "rate_costmap:=5", "-p", "map.grid.length_x:=4.0")
    robot.fuse(1000.0)
    robot.wait(lambda: "costmap" in robot.heard)
    assert (robot.heard["costmap"].info.width, robot.heard["costmap"].info.height) == (40, 80)


def test_simulated_time_that_starts_over(make_robot):
    robot = make_robot("", "-p", "use_sim_time:=true")
    clock = robot.create_publisher(Clock, "/clock", 10)
    for begin in (100.0, 50.0):
        before, k = robot.count("fused"), 0
        while robot.count("fused") <= before + 5:
            k += 1
            assert k < 300, robot.heard["counts"]
            stamp = begin + 0.05 * k
            now = Clock()
            now.clock.sec, now.clock.nanosec = int(stamp), round(stamp % 1 * 1e9)
            clock.publish(now)
            robot.send_poses(stamp)
            robot.spin(0.03)
            robot.send_cloud(stamp)
            robot.spin(0.03)
    assert robot.count("jumps") == 1
