"""The node: rclpy around `sensors`, `intake`, an engine, `publishing` and `services`. Imports ROS."""

from __future__ import annotations

import dataclasses
import math
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from builtin_interfaces.msg import Time as Stamp
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from torchelev.io.bags.covariance import PoseCovariances
from torchelev.io.bags.messages.cloud import CloudError
from torchelev.io.bags.scans import clean, stamp_of
from torchelev.ros2.engine import SensorInput, thinned
from torchelev.ros2.engines import make_engine
from torchelev.ros2.intake import Intake, Waiting
from torchelev.ros2.parameters import merged_parameters
from torchelev.ros2.publishing import Publishers
from torchelev.ros2.sensors import Reading, Sensor
from torchelev.ros2.services import Services
from torchelev.ros2.settings import NodeSettings, list_changeable
from torchelev.ros2.transforms import TransformException, Transforms

_SHORTEST, _LONGEST = 0.005, 0.1  # [s] between looks at what is due
_RECENT = 1.0  # [s] by which the covariance of a pose may be older than a cloud


class ElevationMappingNode(Node):
    """Keeps a map of the ground around a robot.

    One thread runs all callbacks, so that nothing reads the map while it is updated.

    Args:
        settings: what a file says; parameters of ROS come first.
        cfg: the map's settings.
    """

    def __init__(self, settings: NodeSettings, cfg: dict[str, Any]) -> None:
        super().__init__("elevation_mapping", automatically_declare_parameters_from_overrides=True)
        self.settings, cfg = merged_parameters(self, settings, cfg)
        self.engine = make_engine(cfg, self.settings)
        self._require_layers(self.settings)
        topics = (*self.settings.clouds, *self.settings.depths)
        self.intake = Intake(map(self.resolve_topic_name, topics), self.settings.transform_wait)
        self.stamp: Stamp | None = None  # of the map: of the newest cloud, or of the time when it was loaded
        self.transforms = Transforms(self, self.settings.map_frame)
        self._odometry = PoseCovariances(), -math.inf  # the newest covariance, and its stamp [s]
        self._warned: dict[str, float] = {}
        self.outputs = Publishers(self, cfg.get("sensor", {}).get("body"))
        services = Services(self)
        self._subscribe()
        self.add_on_set_parameters_callback(self._set)
        self._timer = self.create_timer(_LONGEST, self._work, clock=Clock(clock_type=ClockType.STEADY_TIME))
        back = JumpThreshold(min_forward=None, min_backward=Duration(seconds=-1), on_clock_change=True)
        self._jumps = self.get_clock().create_jump_callback(back, post_callback=lambda _: self._start_over())
        if self.settings.load_on_start and Path(self.settings.map_file).exists():
            self._load_first(services)
        grid, names = self.engine.window(), ", ".join(map(self.resolve_topic_name, topics))
        size = f"{grid.shape[0]} x {grid.shape[1]} cells of {grid.resolution:g} m"
        self.get_logger().info(f"{type(self.engine).__name__}: {size} in {self.settings.map_frame}, from {names}")

    def _load_first(self, services: Services) -> None:
        """Load the map that was saved. A file that does not fit must not end a node that is started again and again."""
        try:
            self.get_logger().info(services.load())
        except (ValueError, OSError) as error:
            self.get_logger().error(f"load_on_start: the map starts empty: {error}")

    # Parameters ------------------------------------------------------------------------------------------------------

    def _set(self, parameters: list[Any]) -> SetParametersResult:
        """Take new values of parameters that may change; refuse wrong ones with a sentence."""
        values = {one.name: one.value for one in parameters if one.name in list_changeable()}
        of_map = next((one.name for one in parameters if one.name.startswith("map.")), None)
        if of_map is not None:
            return SetParametersResult(successful=False, reason=f"{of_map}: settings of the map need a restart")
        try:
            settings = dataclasses.replace(self.settings, **values)
            self._require_layers(settings)
        except (ValueError, TypeError) as error:
            return SetParametersResult(successful=False, reason=str(error))
        self.settings = settings
        return SetParametersResult(successful=True)

    def _require_layers(self, settings: NodeSettings) -> None:
        for name in settings.layers:
            try:
                self.engine.layer(name)
            except ValueError as error:
                raise ValueError(f"layers: {str(error).partition(': ')[2]}") from error

    # Sensors ---------------------------------------------------------------------------------------------------------

    def _subscribe(self) -> None:
        settings = self.settings
        kind = ReliabilityPolicy.RELIABLE if settings.reliable else ReliabilityPolicy.BEST_EFFORT
        qos = QoSProfile(depth=1, reliability=kind)  # the newest one only, so that none is fused late
        for topic in map(self.resolve_topic_name, settings.clouds):
            self.create_subscription(PointCloud2, topic, self._receiver(Sensor(topic)), qos)
        depths = [self.resolve_topic_name(topic) for topic in settings.depths]
        infos = settings.camera_infos or [f"{topic.rpartition('/')[0]}/camera_info" for topic in depths]
        for topic, info in zip(depths, infos, strict=True):
            sensor = Sensor(topic, is_depth=True, scale=settings.depth_scale or None)
            self.create_subscription(Image, topic, self._receiver(sensor), qos)
            self.create_subscription(CameraInfo, info, lambda message, to=sensor: setattr(to, "camera", message), qos)
        if settings.odometry:
            self.create_subscription(Odometry, settings.odometry, self._keep_covariance, qos)

    def _receiver(self, sensor: Sensor) -> Callable[[Any], None]:
        def receive(message: Any) -> None:
            stamp = stamp_of(message.header)
            if stamp <= 0:
                rule = f"its stamp must be positive, got {stamp:g}; let its driver set it"
                self._warn(f"{sensor.topic}: left out a message: {rule}", f"{sensor.topic} stamp")
            sensor.note(stamp)
            if self.intake.offer(sensor.topic, Reading(sensor, message), stamp, self.now()):
                self._forget_transforms()
            self._work()

        return receive

    def _keep_covariance(self, message: Odometry) -> None:
        """Keep the newest covariance, if it is that of the base in the map's frame."""
        frames, expected = (
            (message.header.frame_id, message.child_frame_id),
            (self.settings.map_frame, self.settings.base_frame),
        )
        if tuple(map(clean, frames)) != expected:
            rule = f"its frames must be {' and '.join(expected)}, got {' and '.join(frames)}"
            self._warn(f"{self.settings.odometry}: its covariance is not used: {rule}", "odometry", 60.0)
            return
        self._odometry = PoseCovariances(self.settings.odometry), stamp_of(message.header)
        self._odometry[0].add(message)
        for note in self._odometry[0].notes:
            self._warn(note, "covariance", 60.0)

    def _covariance_at(self, stamp: float, lever: Any) -> Any:
        """Return the covariance (6, 6) of a sensor's pose, see `PoseCovariances.of_sensor`; None if none is recent."""
        known, of = self._odometry
        return known.of_sensor(stamp, lever) if abs(stamp - of) <= _RECENT else None

    def now(self) -> float:
        """Return the time [s] by the node's clock."""
        return 1e-9 * self.get_clock().now().nanoseconds

    def stamp_now(self) -> None:
        """Stamp a map that did not come from a cloud."""
        self.stamp = self.get_clock().now().to_msg()

    def _warn(self, text: str, kind: str, pause: float = 5.0) -> None:
        """Log a warning, unless one of its kind was logged less than a pause [s] ago."""
        now = time.monotonic()  # rclpy's own throttle distinguishes messages by the line that logs
        if now - self._warned.get(kind, -math.inf) >= pause:
            self._warned[kind] = now
            self.get_logger().warning(text)

    def _start_over(self) -> None:
        """Go on after the node's clock jumped back."""
        self.intake.start_over()
        self._forget_transforms()

    def _forget_transforms(self) -> None:
        self.transforms.forget()
        self.get_logger().warning("the clock jumped back; transforms from before are forgotten")

    # Updates ---------------------------------------------------------------------------------------------------------

    def _work(self) -> None:
        """Fuse what is ready, publish what is due, and look again soon, if a cloud waits, or when an output is due."""
        self._fuse_waiting()
        rate = self.outputs.publish()
        highest = math.inf if self.intake.is_waiting else max(rate, 1 / _LONGEST)
        period = max(_SHORTEST, 1 / highest)
        if self._timer.timer_period_ns != round(1e9 * period):
            self._timer.timer_period_ns = round(1e9 * period)
            self._timer.reset()

    def _fuse_waiting(self) -> None:
        """Fuse the clouds whose transforms are there."""
        if not self.intake.is_waiting:
            return
        ready, lost = self.intake.take(self.now(), self._is_ready)
        for cloud in ready:
            self._fuse(cloud)
        for cloud in lost:
            self._explain(cloud)

    def _is_ready(self, cloud: Waiting) -> bool:
        """Return whether all transforms are there: at the stamp, and of each point's time."""
        if cloud.reading.sensor.lacks_camera:
            return False
        header, base = cloud.reading.message.header, self.settings.base_frame
        stamp, sensor = Time.from_msg(header.stamp), clean(header.frame_id)
        if not all(self.transforms.has(name, stamp) for name in (sensor, base)):
            return False
        if not all(self.transforms.has(link, stamp, parent=base) for link in self.engine.links):
            return False
        return all(self.transforms.has(sensor, stamp, time) for time in cloud.reading.find_span(self.settings.deskew))

    def _fuse(self, cloud: Waiting) -> None:
        header = cloud.reading.message.header
        try:
            self.engine.update(self._input_of(cloud, clean(header.frame_id), Time.from_msg(header.stamp)))
        except (CloudError, TransformException, ValueError) as error:
            self.intake.counts.unreadable += 1
            kind = getattr(error, "kind", type(error).__name__)
            self._warn(f"{cloud.topic}: left out a message: {error}", f"{cloud.topic} {kind}")
            return
        self.intake.note_fused(cloud, self.now())
        if self.intake.stamp == cloud.stamp:
            self.stamp = header.stamp
        for note in cloud.reading.cloud.notes:
            self._warn(f"{cloud.topic}: {note.text}", f"{cloud.topic} {note.kind}", 60.0)

    def _input_of(self, cloud: Waiting, sensor: str, stamp: Time) -> SensorInput:
        """Return the points of a message with all poses."""
        base, links = self.settings.base_frame, self.engine.links
        points = cloud.reading.points(self.settings.deskew, lambda times: self.transforms.poses(sensor, stamp, times))
        T_map_sensor, T_map_base = self.transforms.pose(sensor, stamp), self.transforms.pose(base, stamp)
        return SensorInput(
            thinned(points, self.settings.max_points),
            T_map_sensor,
            T_map_base,
            self.intake.elapsed(cloud),
            self._covariance_at(cloud.stamp, T_map_sensor[:3, 3] - T_map_base[:3, 3]),
            np.array([self.transforms.pose(link, stamp, base) for link in links]) if links else None,
        )

    def _explain(self, cloud: Waiting) -> None:
        """Say which transform of a message did not arrive in time."""
        header, wait = cloud.reading.message.header, self.settings.transform_wait
        stamp, base = Time.from_msg(header.stamp), self.settings.base_frame
        try:
            for name in (clean(header.frame_id), base):
                self.transforms.pose(name, stamp)
            for link in self.engine.links:
                self.transforms.pose(link, stamp, base)
            reason = "tf does not reach the times of all its points; raise transform_wait, or set deskew false"
            if cloud.reading.sensor.lacks_camera:
                reason = "no CameraInfo was received; see the parameter camera_infos"
        except TransformException as error:
            reason = str(error)
        self._warn(f"{cloud.topic}: left out a message after {wait:g} s: {reason}", f"{cloud.topic} transform")


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
        node.transforms.close()
        node.destroy_node()
        rclpy.try_shutdown()
