"""A robot in ROS 2: it runs the node as a process, sends clouds and transforms, and hears what is published."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PolygonStamped, TransformStamped
from grid_map_msgs.msg import GridMap
from nav_msgs.msg import OccupancyGrid
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Float32MultiArray
from std_srvs.srv import Trigger
from tf2_ros import StaticTransformBroadcaster, TransformBroadcaster
from visualization_msgs.msg import MarkerArray

from torchelev.ros2 import outputs

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
KINDS = (GridMap, PointCloud2, OccupancyGrid, Float32MultiArray, MarkerArray, PolygonStamped, MarkerArray)
TOPICS = {
    name: (kind, LATCHED if topic.is_latched else 100 if name == "polygons" else 1)
    for (name, topic), kind in zip(outputs.TOPICS.items(), KINDS, strict=True)
}


class Robot(Node):
    """What a robot's other nodes do.

    Args:
        config: file of the node.
        name: namespace of the robot; "" for none.
        arguments: more for the node, as after `--ros-args`.
    """

    def __init__(self, config, name="", arguments=()):
        super().__init__("driver", namespace=name)
        self.heard, self.kept = {}, []
        self.prefix = f"{'/' + name if name else ''}/elevation_mapping"
        self.command = [sys.executable, "-m", "torchelev", "ros2", "--config", str(config), "--ros-args", *arguments]
        if name:
            self.command += ["-r", f"__ns:=/{name}"]
        for topic in ("costmap", "points", "height_scan"):
            self.listen(topic)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._diagnose, 10)
        self.moving, self.fixed = TransformBroadcaster(self), StaticTransformBroadcaster(self)
        self.clouds = {}
        self.log = None
        self.process = None

    def listen(self, topic):
        """Hear what the node publishes on one of its topics: the newest in `heard`, all of them in `kept`."""
        kind, qos = TOPICS[topic]
        self.create_subscription(kind, f"{self.prefix}/{topic}", self._hear(topic), qos)

    def _hear(self, topic):
        def keep(message):
            self.heard[topic] = message
            if topic == "polygons":
                self.kept.append(message)

        return keep

    def _diagnose(self, message):
        status = message.status[0]
        if status.name == self.prefix:
            self.heard["status"] = status
            self.heard["counts"] = {entry.key: entry.value for entry in status.values}

    # The node --------------------------------------------------------------------------------------------------------

    def start(self, log):
        """Start the node, and wait until it serves."""
        self.log = log
        with open(log, "a") as file:
            self.process = subprocess.Popen(self.command, stdout=file, stderr=file, cwd=os.path.dirname(str(log)))
        client = self.create_client(Trigger, f"{self.prefix}/clear_map")
        assert client.wait_for_service(20.0), open(log).read()

    def is_alive(self):
        return self.process is None or self.process.poll() is None

    def stop(self, how=signal.SIGINT):
        self.process.send_signal(how)
        self.process.wait(10)
        for topic in list(self.heard):
            del self.heard[topic]

    def call(self, name):
        """Call a Trigger; return whether it succeeded, and what it says."""
        answer = self.ask(name, Trigger)
        return answer.success, answer.message

    def ask(self, name, kind, **request):
        """Call a service of a kind; return its answer."""
        client = self.create_client(kind, f"{self.prefix}/{name}")
        assert client.wait_for_service(5.0)
        return self._answer(client, kind.Request(**request))

    def set(self, **values):
        """Set parameters; return the reason of the first that is refused, or None."""
        client = self.create_client(SetParameters, f"{self.prefix}/set_parameters")
        assert client.wait_for_service(5.0)
        request = SetParameters.Request(
            parameters=[Parameter(k, value=v).to_parameter_msg() for k, v in values.items()]
        )
        refused = [one.reason for one in self._answer(client, request).results if not one.successful]
        return refused[0] if refused else None

    def _answer(self, client, request):
        future = client.call_async(request)
        rclpy.spin_until_future_complete(self, future, timeout_sec=5.0)
        assert future.done(), open(self.log).read()
        return future.result()

    def wait(self, holds, seconds=10.0):
        """Wait until something holds; fail with the node's log if it does not."""
        end = time.monotonic() + seconds
        while not holds():
            assert self.is_alive() and time.monotonic() < end, (self.heard.get("counts"), open(self.log).read())
            rclpy.spin_once(self, timeout_sec=0.02)

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(self, timeout_sec=0.01)

    def count(self, name):
        return int(float(self.heard.get("counts", {}).get(name, 0)))

    # What it sends ---------------------------------------------------------------------------------------------------

    def send_poses(self, stamp, x=0.0, z=0.5):
        self.moving.sendTransform([transform(stamp, "odom", "base_link", x, z)])
        self.fixed.sendTransform([transform(stamp, "base_link", "lidar", 0.0, 0.3)])

    def send_cloud(self, stamp, height=-0.8, topic="/lidar/points", frame="lidar", points=None):
        """Send points (N, 3) [m]; by default flat ground at a height [m] below the sensor."""
        if points is None:
            points = np.random.default_rng(0).uniform(-3, 3, (40000, 3)).astype(np.float32)
            points[:, 2] = height
        self.send(topic, to_cloud(points, stamp, frame))

    def send(self, topic, message):
        if topic not in self.clouds:
            self.clouds[topic] = self.create_publisher(type(message), topic, qos_profile_sensor_data)
            self.wait(lambda: self.clouds[topic].get_subscription_count() > 0)
        self.clouds[topic].publish(message)

    def fuse(self, stamp, **cloud):
        """Send poses and a cloud until it is fused."""
        before = self.count("fused")
        self.send_until(lambda: self.count("fused") > before, stamp, **cloud)

    def send_until(self, holds, stamp, poses=True, **cloud):
        """Send poses and a cloud until something holds: what is sent by best effort may be lost."""
        end = time.monotonic() + 45.0  # a participant that was killed is missed after 20 s
        while not holds():
            assert self.is_alive() and time.monotonic() < end, (self.heard.get("counts"), open(self.log).read())
            if poses:
                self.send_poses(stamp)
                self.spin(0.05)
            self.send_cloud(stamp, **cloud)
            self.spin(0.5 if not holds() else 0.0)


def transform(stamp, parent, child, x, z, y=0.0):
    """A TransformStamped without rotation."""
    one = TransformStamped()
    one.header.stamp.sec, one.header.stamp.nanosec = int(stamp), round(stamp % 1 * 1e9)
    one.header.frame_id, one.child_frame_id = parent, child
    place = one.transform.translation
    place.x, place.y, place.z, one.transform.rotation.w = x, y, z, 1.0
    return one


def to_cloud(xyz, stamp, frame):
    """A PointCloud2 of points (N, 3)."""
    message = PointCloud2(height=1, width=len(xyz), point_step=12, row_step=12 * len(xyz), data=xyz.tobytes())
    message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), round(stamp % 1 * 1e9)
    message.header.frame_id = frame
    message.fields = [PointField(name=n, offset=4 * k, datatype=7, count=1) for k, n in enumerate("xyz")]
    return message


def cells_of(cloud, resolution=0.1):
    """Heights of a map's cloud by the numbers of their cells."""
    values = np.frombuffer(cloud.data, np.float32).reshape(cloud.width, -1)
    keys = np.floor(values[:, :2].astype(np.float64) / resolution).astype(int)
    return {tuple(key): float(z) for key, z in zip(keys.tolist(), values[:, 2], strict=True)}
