"""What the node publishes and serves in real ROS 2, heard by other nodes and read by other libraries."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from grid_map_msgs.srv import GetGridMap
from mcap_ros2.reader import read_ros2_messages
from nav2_msgs.srv import IsPathValid
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from robot import TOPICS, cells_of, transform
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from visualization_msgs.msg import Marker

from torchelev.io.grid_map import from_grid_map

HAS_TORCH = importlib.util.find_spec("torch") is not None
needs_torch = pytest.mark.skipif(not HAS_TORCH, reason="the node's engine is the C library")


def floor_and_table():
    """A floor 0.8 m below the sensor, and a table of 0.4 m on it, from x = 0.8 to 1.8 m."""
    xyz = np.random.default_rng(0).uniform(-3, 3, (40000, 3)).astype(np.float32)
    on_table = (abs(xyz[:, 0] - 1.3) < 0.5) & (abs(xyz[:, 1]) < 0.5)
    xyz[:, 2] = np.where(on_table, -0.4, -0.8)
    return xyz


def fuse_table(robot, times=3):
    for k in range(times):
        robot.fuse(1000.0 + 0.1 * k, points=floor_and_table())


def test_grid_map_is_the_map_and_a_submap_is_a_part_of_it(make_robot):
    robot = make_robot("", "-p", "layers:=[elevation, variance]")
    robot.listen("map")
    fuse_table(robot)
    robot.wait(lambda: {"map", "points"} <= robot.heard.keys())
    message = robot.heard["map"]
    assert message.header.frame_id == "odom" and list(message.layers) == ["elevation", "variance"]
    grid, cells = from_grid_map(message), cells_of(robot.heard["points"])
    i, j = np.nonzero(np.isfinite(grid.layers["elevation"]))
    assert len(i) == len(cells) > 3000
    corner = np.round(grid.center[:2] / 0.1).astype(int) - 40
    assert all(
        cells[(a + corner[0], b + corner[1])] == grid.layers["elevation"][a, b] for a, b in zip(i, j, strict=True)
    )
    asked = {"frame_id": "odom", "position_x": 1.3, "position_y": 0.0, "length_x": 0.6, "length_y": 0.4}
    part = from_grid_map(robot.ask("get_submap", GetGridMap, **asked, layers=["elevation"]).map)
    assert part.layers["elevation"].shape == (6, 4)
    np.testing.assert_allclose(part.layers["elevation"], 0.4, atol=0.01)
    for wrong in (
        {"frame_id": "map"},
        {"position_x": 90.0},
        {"layers": ["elevaton"]},
        {"length_x": float("inf")},
        {"length_x": 0.0},
    ):
        assert list(robot.ask("get_submap", GetGridMap, **asked | wrong).map.layers) == []
    text = Path(robot.log).read_text()
    for words in (
        "frame_id: must be odom, got 'map'",
        "has no cells around",
        "layer: must be ",
        "length_x, length_y: must be positive",
    ):
        assert words in text


def test_covariance_of_odometry_is_in_the_variances(make_robot):
    robot = make_robot("", "-p", "odometry:=/odom", "-p", "layers:=[elevation, variance]")
    odometry = Odometry()
    odometry.header.frame_id, odometry.child_frame_id = "world", "base_link"
    odometry.header.stamp.sec = 1000
    odometry.pose.covariance[14] = 0.04  # [m^2] of z

    def least_variance(stamp):
        for _ in range(3):
            robot.send("/odom", odometry)
            robot.spin(0.05)
        robot.fuse(stamp)
        robot.heard.pop("points", None)
        robot.wait(lambda: "points" in robot.heard)
        return np.frombuffer(robot.heard["points"].data, np.float32).reshape(-1, 4)[:, 3].min()

    assert least_variance(1000.0) < 0.01
    assert "frames must be odom and base_link, got world and base_link" in Path(robot.log).read_text()
    assert robot.call("clear_map")[0]
    odometry.header.frame_id = "odom"
    assert least_variance(1000.1) > 0.04
    assert robot.call("clear_map")[0]
    assert least_variance(1005.0) < 0.01, "an old covariance"


def test_points_on_the_robots_links_are_left_out_and_its_shapes_shown(make_robot, tmp_path, prepared):
    config = tmp_path / "body.yaml"
    shape = "{link: arm, start: [0, 0, 0], end: [0, 0, -0.5], radius: 0.2}"
    body = f"sensor: {{body: {{capsules: [{shape}]}}}}, grid:"
    config.write_text((prepared / "robot.yaml").read_text().replace("map: {grid:", f"map: {{{body}"))
    robot = make_robot(config=config)
    robot.listen("body")
    robot.send_until(lambda: robot.count("without_transform") >= 1, 1000.0)
    assert '"arm"' in Path(robot.log).read_text()
    robot.moving.sendTransform([transform(1000.1 + 0.1 * k, "base_link", "arm", 1.0, -0.2) for k in range(-1, 9)])
    robot.fuse(1000.3)
    robot.wait(lambda: robot.count("rejected_body") > 100)
    robot.wait(lambda: "body" in robot.heard)
    markers = robot.heard["body"].markers
    assert [one.type for one in markers] == [Marker.CYLINDER, Marker.SPHERE, Marker.SPHERE]
    assert {one.header.frame_id for one in markers} == {"arm"} and markers[0].scale.z == pytest.approx(0.5)
    assert markers[0].pose.position.z == pytest.approx(-0.25) and markers[0].frame_locked


def test_the_first_map_below_the_feet_and_places_that_are_forgotten(make_robot):
    robot = make_robot("", "-p", "feet:=[left, right, hind]", "-p", "foot_height:=0.05", "-p", "clear_radius:=0.5")
    assert robot.call("initialize")[0] is False
    robot.send_poses(1000.0)
    places = {"left": (0.5, 0.4), "right": (0.5, -0.4), "hind": (-0.5, 0.0)}
    robot.fixed.sendTransform([transform(1000.0, "base_link", foot, x, -0.45, y) for foot, (x, y) in places.items()])
    robot.spin(0.5)
    assert robot.call("initialize") == (True, "the ground below left, right, hind is in the map")
    robot.wait(lambda: "points" in robot.heard)
    first = cells_of(robot.heard["points"])
    assert 20 < len(first) < 120
    np.testing.assert_allclose(list(first.values()), 0.0, atol=1e-5)  # the base is at 0.5 m
    robot.fuse(1000.1)
    assert robot.call("clear_around_robot") == (True, "cleared 0.5 m around x = 0.00 m, y = 0.00 m")
    robot.heard.pop("points", None)
    robot.wait(lambda: "points" in robot.heard)
    left = np.array(list(cells_of(robot.heard["points"]))) * 0.1 + 0.05
    assert np.hypot(*left.T).min() > 0.5 and len(left) > 2000


@needs_torch
def test_planes_as_markers_and_polygons(make_robot):
    robot = make_robot()
    robot.listen("planes")
    robot.listen("polygons")
    fuse_table(robot)
    robot.kept.clear()
    robot.wait(lambda: "planes" in robot.heard and len(robot.kept) >= 4)
    markers = robot.heard["planes"].markers
    assert markers[0].action == Marker.DELETEALL
    outlines = [one for one in markers if one.ns == "boundary"]
    tops = sorted(np.mean([p.z for p in one.points]) for one in outlines)
    assert len(outlines) == 2 and tops == pytest.approx([0.0, 0.4], abs=0.01)
    heights = {round(one.polygon.points[0].z, 1) for one in robot.kept}
    assert heights == {0.0, 0.4} and robot.kept[0].header.frame_id == "odom"


def path_of(*xs):
    message = PathMessage()
    message.header.frame_id = "odom"
    for x in xs:
        pose = PoseStamped()
        pose.pose.position.x, pose.pose.orientation.w = x, 1.0
        message.poses.append(pose)
    return message


@needs_torch
def test_paths_are_checked(make_robot):
    robot = make_robot()
    fuse_table(robot)
    away = robot.ask("check_path", IsPathValid, path=path_of(-1.5, -1.0, -0.5))
    assert away.is_valid and list(away.invalid_pose_indices) == []
    onto = robot.ask("check_path", IsPathValid, path=path_of(-0.5, 0.0, 1.0))
    assert not onto.is_valid and list(onto.invalid_pose_indices) == [2]
    assert not robot.ask("check_path", IsPathValid, path=path_of()).is_valid
    assert not robot.ask("check_path", IsPathValid, path=path_of(float("inf"))).is_valid
    assert not robot.ask("check_path", IsPathValid, path=path_of(20.0)).is_valid, "never seen"
    text = Path(robot.log).read_text()
    assert "every footprint along the path is safe" in text and "path: must have a pose, got none" in text


@pytest.mark.skipif(HAS_TORCH, reason="PyTorch is installed")
def test_what_needs_pytorch_says_so(make_robot):
    robot = make_robot()
    robot.listen("planes")
    fuse_table(robot, 1)
    assert not robot.ask("check_path", IsPathValid, path=path_of(0.0)).is_valid
    robot.wait(lambda: "~/planes is not published: planes: needs PyTorch" in Path(robot.log).read_text())
    assert robot.set(site="/nowhere") is None
    success, text = robot.call("initialize_from_site")
    assert not success and "initialize_from_site: needs PyTorch" in text


@needs_torch
def test_a_site_map_is_where_a_new_robot_starts(make_robot, tmp_path):
    from torchelev import ElevationMap, ElevationMapConfig, GridConfig
    from torchelev.site import SiteMap

    emap = ElevationMap(ElevationMapConfig(grid=GridConfig(resolution=0.1, length_x=4.0, length_y=4.0)))
    import torch

    emap.initialize(torch.tensor([[[0.0, 0.0, 0.25]]]), "nearest")
    emap.variance.fill_(0.01)
    SiteMap(resolution=0.1, path=tmp_path / "site").merge(emap, T_map_base=torch.eye(4)[None], time=1000.0)
    robot = make_robot("", "-p", f"site:={tmp_path / 'site'}")
    robot.send_poses(1000.0)
    robot.spin(0.5)
    assert robot.call("initialize_from_site") == (True, f"the map has what {tmp_path / 'site'} knows")
    robot.wait(lambda: "points" in robot.heard)
    heights = list(cells_of(robot.heard["points"]).values())
    assert len(heights) > 1000 and heights == pytest.approx([0.25] * len(heights), abs=1e-4)


GRID_MAP = {
    "grid_map_msgs/msg/GridMapInfo": (
        "float64 resolution\nfloat64 length_x\nfloat64 length_y\ngeometry_msgs/Pose pose\n"
    ),
    "grid_map_msgs/msg/GridMap": (
        "std_msgs/Header header\ngrid_map_msgs/GridMapInfo info\nstring[] layers\nstring[] basic_layers\n"
        "std_msgs/Float32MultiArray[] data\nuint16 outer_start_index\nuint16 inner_start_index\n"
    ),
}


def test_recorded_messages_are_read_by_rosbags_and_by_mcap(make_robot, tmp_path):
    robot, raw = make_robot(), {}
    for topic in ("map", "costmap", "points", "height_scan"):
        kind, qos = TOPICS[topic]
        name = f"{robot.prefix}/{topic}"
        robot.create_subscription(kind, name, lambda data, to=topic: raw.__setitem__(to, data), qos, raw=True)
    robot.listen("map")
    fuse_table(robot)
    robot.wait(lambda: {"map", "costmap", "points", "height_scan"} <= raw.keys() and "map" in robot.heard)
    robot.spin(1.0)
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in GRID_MAP.items():
        store.register(get_types_from_msg(text, name))
    names = {
        "map": "grid_map_msgs/msg/GridMap",
        "costmap": "nav_msgs/msg/OccupancyGrid",
        "points": "sensor_msgs/msg/PointCloud2",
        "height_scan": "std_msgs/msg/Float32MultiArray",
    }
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        for k, (topic, name) in enumerate(names.items()):
            bag.write(bag.add_connection(f"/{topic}", name, typestore=store), 10**9 + k, raw[topic])
    with AnyReader([tmp_path / "bag"], default_typestore=store) as bag:
        first = {c.topic: bag.deserialize(data, c.msgtype) for c, _, data in bag.messages()}
    second = {one.channel.topic: one.ros_msg for one in read_ros2_messages(next((tmp_path / "bag").glob("*.mcap")))}
    for found in (first, second):
        grid, cells = from_grid_map(found["/map"]), cells_of(found["/points"])
        assert np.isfinite(grid.layers["elevation"]).sum() == len(cells) > 3000
        costs = np.array(found["/costmap"].data, np.int8).reshape(80, 80)  # [y, x]
        # Nav2's costmaps: -1 unknown, 0 free to 100 lethal; 99 is an inscribed obstacle, which only they compute.
        assert set(np.unique(costs)) <= {-1, *range(99), 100} and {-1, 0, 100} <= set(np.unique(costs))
        assert costs[40, 40 - 15] == 0 and (costs[35:45, 48] == 100).any()  # the floor; the table's edge at 0.8 m
        assert len(found["/height_scan"].data) == 187
