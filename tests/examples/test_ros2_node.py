"""The ROS 2 node, run against stand-ins of the ROS packages that have the members it uses."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from tests.io.bags.synthetic import make_cloud
from tests.io.bags.test_point_cloud import Plain
from torchelev.io.bags.grid_maps import from_message

NODE = Path(__file__).parents[2] / "examples" / "ros2" / "elevation_mapping_node.py"
PARAMETERS = {"resolution": 0.2, "length": 4.0, "compile": False, "layers": ["elevation", "variance"]}


class TransformException(Exception):
    pass


def point(x=0.0, y=0.0, z=0.0):
    return SimpleNamespace(x=x, y=y, z=z)


def header(frame_id="", sec=0, nanosec=0):
    return SimpleNamespace(frame_id=frame_id, stamp=SimpleNamespace(sec=sec, nanosec=nanosec))


def info(**fields):
    pose = SimpleNamespace(position=point(), orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0))
    return SimpleNamespace(pose=pose, **fields)


def grid_map(**fields):
    return SimpleNamespace(outer_start_index=0, inner_start_index=0, **fields)


class Node:
    """rclpy.node.Node: what is published and logged is kept."""

    def __init__(self, name):
        self.published, self.logged, self.subscriptions, self.timers = [], [], {}, []

    def declare_parameter(self, name, value):
        return SimpleNamespace(value=PARAMETERS.get(name, value))

    def get_logger(self):
        return SimpleNamespace(info=self.logged.append, warning=lambda text, once=False: self.logged.append(text))

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=self.published.append)

    def create_subscription(self, kind, topic, callback, qos):
        self.subscriptions[topic] = callback

    def create_timer(self, period, callback):
        self.timers.append((period, callback))


class Buffer:
    """tf2_ros.Buffer: the lidar is 0.5 m above a base that stands at (1, 2)."""

    def lookup_transform(self, target, source, time, timeout):
        if target != "odom" or source not in ("base_link", "lidar"):
            raise TransformException(f"{source} does not exist")
        rotation = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
        return SimpleNamespace(
            transform=SimpleNamespace(translation=point(1.0, 2.0, 0.5 if source == "lidar" else 0.0), rotation=rotation)
        )


@pytest.fixture
def node(monkeypatch):
    """The node, made from its file with stand-ins in place of ROS."""
    members = {
        "rclpy": {},
        "rclpy.duration": {"Duration": lambda seconds: seconds},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "rclpy.time": {"Time": SimpleNamespace(from_msg=lambda stamp: stamp)},
        "sensor_msgs.msg": {"PointCloud2": object},
        "grid_map_msgs.msg": {"GridMap": grid_map, "GridMapInfo": info},
        "std_msgs.msg": {
            "Header": header,
            "Float32MultiArray": SimpleNamespace,
            "MultiArrayDimension": SimpleNamespace,
            "MultiArrayLayout": lambda dim: SimpleNamespace(dim=dim, data_offset=0),
        },
        "tf2_ros": {
            "Buffer": Buffer, "TransformException": TransformException, "TransformListener": lambda buffer, node: None,
        },
    }  # fmt: skip
    for name, values in members.items():
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)
        monkeypatch.setitem(sys.modules, name.split(".")[0], sys.modules.get(name.split(".")[0], ModuleType(name)))
    spec = importlib.util.spec_from_file_location("elevation_mapping_node", NODE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.ElevationMapping()


def cloud(frame="lidar", sec=5, order="xyz"):
    xy = np.random.default_rng(0).uniform(-1, 1, (3000, 2))
    points = np.column_stack([xy, np.full(3000, -0.7)]).astype(np.float32)
    return make_cloud(Plain(), points, None, header(frame, sec), order=order)


@pytest.mark.slow(1)
def test_clouds_in_a_grid_map_out(node):
    ((period, publish),) = node.timers
    publish()
    assert period == 0.2 and not node.published  # nothing was seen yet
    node.subscriptions["/points"](cloud())
    node.subscriptions["/points"](cloud(sec=6))
    publish()
    read = from_message(node.published[0])
    assert (read.frame, read.stamp, read.resolution) == ("odom", 6.0, 0.2)
    elevation = read.layers["elevation"]
    assert np.nanmax(np.abs(elevation + 0.2)) < 1e-5 and np.isfinite(elevation).sum() > 80
    assert list(read.layers) == ["elevation", "variance"] and np.abs(read.center[:2] - [1, 2]).max() <= 0.1


@pytest.mark.parametrize("wrong", [dict(frame="mast"), dict(order="xy")])
def test_a_cloud_that_cannot_be_used_is_logged(node, wrong):
    node.subscriptions["/points"](cloud(**wrong))
    assert "left out a cloud" in node.logged[-1] and node.stamp is None
