"""The node: what rclpy subscribes to, publishes and serves, around `intake`, `engines` and `outputs`."""

from __future__ import annotations

import dataclasses
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from builtin_interfaces.msg import Time as Stamp
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import OccupancyGrid
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float32MultiArray, Header
from std_srvs.srv import Trigger
from tf2_ros import Buffer, TransformException, TransformListener

from torchelev.io.bags.point_cloud import CloudError, read_xyz
from torchelev.io.bags.scans import clean, stamp_of
from torchelev.ros2 import messages, outputs
from torchelev.ros2.engine import thinned
from torchelev.ros2.engines import make_engine
from torchelev.ros2.intake import Intake, Waiting
from torchelev.ros2.settings import NodeSettings, changeable, is_of_ros, make_settings, nested, split

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
        super().__init__("elevation_mapping", automatically_declare_parameters_from_overrides=True)
        given, overrides = self._given()
        self.settings = make_settings({**dataclasses.asdict(settings), **given})
        self._declare(given)
        self.engine = make_engine(_merged(cfg, overrides), self.settings)
        self._require_layers(self.settings)
        self.intake, self.schedule = Intake(self.settings.transform_wait), outputs.Schedule()
        self.stamp: Stamp | None = None  # of the map: of the newest cloud, or of the time when it was loaded
        self.buffer = Buffer()
        self._listener = TransformListener(self.buffer, self)
        self._outputs = self._make_outputs()
        for topic in self.settings.clouds:
            self.create_subscription(PointCloud2, topic, self._receiver(topic), self._qos())
        for name, act in (("save_map", self._save), ("load_map", self._load), ("clear_map", self._clear)):
            self.create_service(Trigger, f"~/{name}", _service(act))
        self.add_on_set_parameters_callback(self._set)
        self.create_timer(_TICK, self._work, clock=Clock(clock_type=ClockType.STEADY_TIME))
        back = JumpThreshold(min_forward=None, min_backward=Duration(seconds=-1), on_clock_change=True)
        self._jumps = self.get_clock().create_jump_callback(back, post_callback=lambda _: self._start_over())
        if self.settings.load_on_start and Path(self.settings.map_file).exists():
            self.get_logger().info(self._load())

    # Parameters ------------------------------------------------------------------------------------------------------

    def _given(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the parameters that ROS was given: the node's, and the map's settings."""
        given = {name: one.value for name, one in self.get_parameters_by_prefix("").items() if not is_of_ros(name)}
        return split(nested(given))

    def _declare(self, given: dict[str, Any]) -> None:
        """Declare all parameters with their meanings."""
        for each in dataclasses.fields(self.settings):
            value, read_only = getattr(self.settings, each.name), not each.metadata["changeable"]
            describe = ParameterDescriptor(
                name=each.name, description=each.metadata["meaning"], read_only=read_only, dynamic_typing=True
            )
            if each.name in given:
                self.undeclare_parameter(each.name)
            plain = list(value) if isinstance(value, tuple) else value
            self.declare_parameter(each.name, plain, describe, ignore_override=True)

    def _qos(self) -> QoSProfile:
        """Return that of clouds: the newest one only, so that none is fused late."""
        kind = ReliabilityPolicy.RELIABLE if self.settings.reliable else ReliabilityPolicy.BEST_EFFORT
        return QoSProfile(depth=1, reliability=kind)

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
            stamp = stamp_of(message.header)
            if stamp <= 0:
                text = f"{topic}: left out a cloud: its stamp must be positive, got {stamp:g}; let its driver set it"
                self.get_logger().warning(text, throttle_duration_sec=5.0)
            if self.intake.offer(topic, message, stamp, self._now()):
                self._forget_transforms()
            self._work()

        return receive

    def _now(self) -> float:
        return 1e-9 * self.get_clock().now().nanoseconds

    def _start_over(self) -> None:
        """Go on after the node's clock jumped back."""
        self.intake.start_over()
        self._forget_transforms()

    def _forget_transforms(self) -> None:
        self.buffer.clear()
        self.get_logger().warning("the clock jumped back; transforms from before are forgotten")

    def _is_ready(self, cloud: Waiting) -> bool:
        stamp, frames = Time.from_msg(cloud.message.header.stamp), self.settings
        sensor = clean(cloud.message.header.frame_id)
        return all(self.buffer.can_transform(frames.map_frame, name, stamp) for name in (sensor, frames.base_frame))

    def _work(self) -> None:
        """Fuse the clouds whose transforms are there, and publish what is due."""
        ready, lost = self.intake.take(self._now(), self._is_ready)
        for cloud in ready:
            self._fuse(cloud)
        for cloud in lost:
            self._explain(cloud)
        for name, (publisher, make) in self._outputs.items():
            self._publish(name, publisher, make)

    def _fuse(self, cloud: Waiting) -> None:
        header = cloud.message.header
        try:
            points = thinned(read_xyz(cloud.message)[0], self.settings.max_points)
            T_map_sensor = self._pose(clean(header.frame_id), Time.from_msg(header.stamp))
            T_map_base = self._pose(self.settings.base_frame, Time.from_msg(header.stamp))
            self.engine.update(points, T_map_sensor, T_map_base, self.intake.elapsed(cloud))
            self.intake.note_fused(cloud, self._now())
            if self.intake.stamp == cloud.stamp:
                self.stamp = header.stamp
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
        if not publisher.get_subscription_count() or (self.stamp is None and name != "diagnostics"):
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
        return Header(frame_id=self.settings.map_frame, stamp=self.stamp)

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
        findings = [*self.intake.findings(self._now()), *self.engine.diagnose()]
        stamp = self.get_clock().now().to_msg()
        return messages.to_diagnostics(self.get_fully_qualified_name(), values, findings, stamp)

    # Services --------------------------------------------------------------------------------------------------------

    def _save(self) -> str:
        self.engine.save(Path(self.settings.map_file))
        return f"saved {Path(self.settings.map_file).absolute()}"

    def _load(self) -> str:
        self.engine.load(Path(self.settings.map_file))
        self.stamp = self.get_clock().now().to_msg()
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
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # rclpy's own handler ends the spin, not an exception in its midst
    try:
        rclpy.init(args=arguments)
        node = ElevationMappingNode(settings, cfg)
    except (ParameterException, RuntimeError) as error:  # what ROS was given
        raise ValueError(f"--ros-args: {error}") from error
    try:
        rclpy.spin(node)
    except ExternalShutdownException:
        pass
    except Exception:
        if rclpy.ok():  # else it was shut down in the middle of its work
            raise
    finally:
        rclpy.try_shutdown()


def _merged(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    """Return nested settings, of which the second come first."""
    both = dict(a)
    for name, value in b.items():
        old = both.get(name)
        both[name] = _merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return both
