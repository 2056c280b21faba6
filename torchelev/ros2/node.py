"""The node: what rclpy subscribes to, publishes and serves, around `intake`, `engines` and `outputs`."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import OccupancyGrid
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float32MultiArray
from std_srvs.srv import Trigger
from tf2_ros import Buffer, TransformException, TransformListener

from torchelev.io.bags.point_cloud import CloudError, read_points
from torchelev.io.bags.scans import clean, stamp_of
from torchelev.ros2 import messages, outputs
from torchelev.ros2.engine import thinned
from torchelev.ros2.engines import make_engine
from torchelev.ros2.intake import Intake, Waiting
from torchelev.ros2.settings import NodeSettings, changeable, make_settings

_TICK = 0.005  # [s] between looks at what is due
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # late subscribers get the last one


class ElevationMappingNode(Node):
    """Keeps a map of the ground around a robot.

    One thread runs all callbacks, so that nothing reads the map while it is updated.

    Args:
        settings: what a file says; parameters of ROS come first.
        cfg: the map's settings.
    """

    def __init__(self, settings: NodeSettings, cfg: dict[str, Any]) -> None:
        super().__init__("elevation_mapping")
        self.settings = make_settings(self._declare(settings))
        self.engine = make_engine(cfg, self.settings)
        self._require_layers(self.settings)
        self.intake, self.schedule = Intake(self.settings.transform_wait), outputs.Schedule()
        self.has_map = False  # something was fused or loaded
        self.buffer = Buffer()
        self._listener = TransformListener(self.buffer, self)
        self._outputs = self._make_outputs()
        for topic in self.settings.clouds:
            self.create_subscription(PointCloud2, topic, self._receiver(topic), qos_profile_sensor_data)
        for name, act in (("save_map", self._save), ("load_map", self._load), ("clear_map", self._clear)):
            self.create_service(Trigger, f"~/{name}", _service(act))
        self.add_on_set_parameters_callback(self._set)
        self.create_timer(_TICK, self._work)
        if self.settings.load_on_start and Path(self.settings.map_file).exists():
            self.get_logger().info(self._load())

    # Parameters ------------------------------------------------------------------------------------------------------

    def _declare(self, settings: NodeSettings) -> dict[str, Any]:
        """Declare all parameters; return their values."""
        values = {}
        for each in dataclasses.fields(settings):
            default = getattr(settings, each.name)
            describe = ParameterDescriptor(
                description=each.metadata["meaning"], read_only=not each.metadata["changeable"]
            )
            given = list(default) if isinstance(default, tuple) else default
            values[each.name] = self.declare_parameter(each.name, given, describe).value
        return values

    def _set(self, parameters: list[Any]) -> SetParametersResult:
        """Take new values of parameters that may change; refuse wrong ones with a sentence."""
        values = {one.name: one.value for one in parameters if one.name in changeable()}
        try:
            settings = dataclasses.replace(self.settings, **values)
            self._require_layers(settings)
        except (ValueError, TypeError) as error:
            return SetParametersResult(successful=False, reason=str(error))
        self.settings = settings
        return SetParametersResult(successful=True)

    def _require_layers(self, settings: NodeSettings) -> None:
        for name in settings.layers:
            self.engine.layer(name)  # raises ValueError for one that is not there

    # Clouds ----------------------------------------------------------------------------------------------------------

    def _receiver(self, topic: str) -> Callable[[PointCloud2], None]:
        def receive(message: PointCloud2) -> None:
            if self.intake.offer(topic, message, stamp_of(message.header), time.monotonic()):
                self.buffer.clear()
                self.get_logger().warning(f"{topic}: the clock jumped back; transforms from before are forgotten")
            self._work()

        return receive

    def _is_ready(self, cloud: Waiting) -> bool:
        stamp, frames = Time.from_msg(cloud.message.header.stamp), self.settings
        sensor = clean(cloud.message.header.frame_id)
        return all(self.buffer.can_transform(frames.map_frame, name, stamp) for name in (sensor, frames.base_frame))

    def _work(self) -> None:
        """Fuse the clouds whose transforms are there, and publish what is due."""
        ready, lost = self.intake.take(time.monotonic(), self._is_ready)
        for cloud in ready:
            self._fuse(cloud)
        for cloud in lost:
            self._explain(cloud)
        for name, (publisher, make) in self._outputs.items():
            self._publish(name, publisher, make)

    def _fuse(self, cloud: Waiting) -> None:
        header = cloud.message.header
        try:
            points = thinned(read_points(cloud.message, cloud.stamp).points, self.settings.max_points)
            T_map_sensor = self._pose(clean(header.frame_id), Time.from_msg(header.stamp))
            T_map_base = self._pose(self.settings.base_frame, Time.from_msg(header.stamp))
            dt = self.intake.step(cloud)
            self.engine.update(points, T_map_sensor, T_map_base, dt)
            self.has_map = True
        except (CloudError, TransformException, ValueError) as error:
            self.intake.counts.unreadable += 1
            self.get_logger().warning(f"{cloud.topic}: left out a cloud: {error}", throttle_duration_sec=5.0)

    def _explain(self, cloud: Waiting) -> None:
        """Say which transform a cloud waited for in vain."""
        header, frames = cloud.message.header, self.settings
        for name in (clean(header.frame_id), frames.base_frame):
            try:
                self._pose(name, Time.from_msg(header.stamp))
            except TransformException as error:
                text = f"{cloud.topic}: left out a cloud after {frames.transform_wait:g} s: {error}"
                self.get_logger().warning(text, throttle_duration_sec=5.0)
                return

    def _pose(self, frame: str, stamp: Time) -> Any:
        return messages.matrix_of(self.buffer.lookup_transform(self.settings.map_frame, frame, stamp).transform)

    # Outputs ---------------------------------------------------------------------------------------------------------

    def _make_outputs(self) -> dict[str, tuple[Any, Callable[[], Any]]]:
        """Return each output's publisher and what makes its message."""
        found = {
            "points": (self.create_publisher(PointCloud2, "~/points", 1), self._make_points),
            "costmap": (self.create_publisher(OccupancyGrid, "~/costmap", _LATCHED), self._make_costmap),
            "height_scan": (self.create_publisher(Float32MultiArray, "~/height_scan", 1), self._make_scan),
            "diagnostics": (self.create_publisher(DiagnosticArray, "/diagnostics", 1), self._make_diagnostics),
        }
        try:
            from grid_map_msgs.msg import GridMap
        except ModuleNotFoundError:
            self.get_logger().warning("no grid_map_msgs: ~/map is not published; install ros-$ROS_DISTRO-grid-map-msgs")
        else:
            found["map"] = (self.create_publisher(GridMap, "~/map", _LATCHED), self._make_map)
        return found

    def _publish(self, name: str, publisher: Any, make: Callable[[], Any]) -> None:
        """Publish an output if it is due, there is a map, and somebody listens."""
        if not (self.has_map and publisher.get_subscription_count()):
            return
        if self.schedule.is_due(name, getattr(self.settings, f"rate_{name}"), time.monotonic()):
            try:
                message = make()
            except ValueError as error:  # the map has no such layer
                self.get_logger().warning(f"~/{name} is not published: {error}", throttle_duration_sec=30.0)
                return
            if message is not None:
                publisher.publish(message)

    def _header(self) -> Any:
        stamp = self.intake.stamp
        if stamp is None:  # of a map that was loaded
            stamp = 1e-9 * self.get_clock().now().nanoseconds
        return messages.header_of(self.settings.map_frame, stamp)

    def _make_map(self) -> Any:
        return messages.to_grid_map(outputs.grid_map(self.engine, self.settings.layers), self._header())

    def _make_points(self) -> PointCloud2:
        return messages.to_cloud(outputs.map_cloud(self.engine, self.settings.layers), self._header())

    def _make_costmap(self) -> OccupancyGrid:
        grid = outputs.costmap(self.engine, self.settings.min_traversability)
        return messages.to_occupancy_grid(grid, self._header())

    def _make_scan(self) -> Float32MultiArray | None:
        try:
            T_map_base = self._pose(self.settings.base_frame, Time())  # the newest
        except TransformException:
            return None
        return messages.to_scan(self.engine.scan(T_map_base), self.settings.height_scan)

    def _make_diagnostics(self) -> DiagnosticArray:
        values = {**self.intake.counts.as_dict(), **self.engine.statistics()}
        stamp = self.get_clock().now().to_msg()
        return messages.to_diagnostics(self.get_fully_qualified_name(), values, self.engine.diagnose(), stamp)

    # Services --------------------------------------------------------------------------------------------------------

    def _save(self) -> str:
        self.engine.save(Path(self.settings.map_file))
        return f"saved {Path(self.settings.map_file).absolute()}"

    def _load(self) -> str:
        self.engine.load(Path(self.settings.map_file))
        self.has_map = True
        return f"loaded {Path(self.settings.map_file).absolute()}"

    def _clear(self) -> str:
        self.engine.reset()
        return "the map is empty"


def _service(act: Callable[[], str]) -> Callable[[Any, Any], Any]:
    """Return the callback of a Trigger: the sentence that `act` returns, or that of its error."""

    def call(_: Any, response: Any) -> Any:
        try:
            response.success, response.message = True, act()
        except (ValueError, OSError) as error:
            response.success, response.message = False, str(error)
        return response

    return call


def spin(settings: NodeSettings, cfg: dict[str, Any], arguments: list[str]) -> None:
    """Run a node until it is shut down or interrupted.

    Args:
        settings: of a file.
        cfg: the map's settings.
        arguments: for ROS, such as `--ros-args -r points:=/lidar`.
    """
    rclpy.init(args=arguments)
    try:
        node = ElevationMappingNode(settings, cfg)
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
