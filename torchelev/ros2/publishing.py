"""What a node publishes, when it is due and somebody listens. Imports ROS."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PolygonStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float32MultiArray, Header
from visualization_msgs.msg import MarkerArray

from torchelev.ros2 import messages, outputs
from torchelev.ros2.transforms import TransformException

if TYPE_CHECKING:
    from torchelev.ros2.node import ElevationMappingNode

_LATCHED = DurabilityPolicy.TRANSIENT_LOCAL
_MANY = 100  # polygons of one map that wait in the middleware


class Publishers:
    """The publishers of a node. A message is a function of the node's map at the time when it is due."""

    def __init__(self, node: ElevationMappingNode, body: dict[str, Any] | None) -> None:
        self._node, self._schedule = node, outputs.Schedule()
        self._makers: dict[str, tuple[list[Any], Callable[[], None]]] = {}
        self._offer("points", self._make_points, PointCloud2)
        self._offer("costmap", self._make_costmap, OccupancyGrid)
        self._offer("height_scan", self._make_scan, Float32MultiArray)
        diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 1)
        self._offer("diagnostics", self._make_diagnostics, DiagnosticArray, diagnostics)
        self._planes = self._publisher("planes", MarkerArray)
        self._polygons = self._publisher("polygons", PolygonStamped)
        self._makers["planes"] = [self._planes, self._polygons], self._make_planes
        try:
            from grid_map_msgs.msg import GridMap
        except ModuleNotFoundError:
            node.get_logger().warning("no grid_map_msgs: ~/map is not published; install ros-$ROS_DISTRO-grid-map-msgs")
        else:
            self._offer("map", self._make_map, GridMap)
        solids = outputs.make_solids(body, node.settings.base_frame)
        self._publisher("body", MarkerArray).publish(messages.to_body_markers(solids))

    def _publisher(self, name: str, kind: Any) -> Any:
        durability = _LATCHED if outputs.TOPICS[name].is_latched else DurabilityPolicy.VOLATILE
        depth = _MANY if name == "polygons" else 1
        return self._node.create_publisher(kind, f"~/{name}", QoSProfile(depth=depth, durability=durability))

    def _offer(self, name: str, make: Callable[[], Any], kind: Any, publisher: Any = None) -> None:
        publisher = publisher or self._publisher(name, kind)

        def publish() -> None:
            message = make()
            if message is not None:
                publisher.publish(message)

        self._makers[name] = [publisher], publish

    def publish(self) -> float:
        """Publish what is due, if there is a map and somebody listens; return the highest rate [Hz] asked for."""
        highest = 0.0
        for name, (publishers, publish) in self._makers.items():
            is_heard = any(one.get_subscription_count() for one in publishers)
            if not is_heard or (self._node.stamp is None and name != "diagnostics"):
                continue
            rate = getattr(self._node.settings, f"rate_{name}")
            highest = max(highest, rate)
            if self._schedule.is_due(name, rate, time.monotonic()):
                try:
                    publish()
                except (ValueError, ImportError) as error:  # no such layer, or a package is missing
                    text = f"~/{name} is not published: {error}"
                    self._node.get_logger().warning(text, throttle_duration_sec=30.0)
        return highest

    def _header(self) -> Header:
        return Header(frame_id=self._node.settings.map_frame, stamp=self._node.stamp)

    def _make_map(self) -> Any:
        grid = outputs.grid_map(self._node.engine, self._node.settings.layers)
        return messages.to_grid_map(grid, self._header())

    def _make_points(self) -> PointCloud2:
        return messages.to_cloud(outputs.map_cloud(self._node.engine, self._node.settings.layers), self._header())

    def _make_costmap(self) -> OccupancyGrid:
        settings = self._node.settings
        grid = outputs.costmap(self._node.engine, settings.min_traversability, settings.robot_height or None)
        return messages.to_occupancy_grid(grid, self._header())

    def _make_scan(self) -> Float32MultiArray | None:
        try:
            T_map_base = self._node.transforms.pose(self._node.settings.base_frame)
        except TransformException:
            return None
        return messages.to_scan(self._node.engine.scan(T_map_base), self._node.settings.height_scan)

    def _make_planes(self) -> None:
        found = outputs.make_outlines(self._node.engine.planes())
        self._planes.publish(messages.to_plane_markers(found, self._header()))
        for outline in found:
            if outline.kind == "inset":
                self._polygons.publish(messages.to_polygon(outline, self._header()))

    def _make_diagnostics(self) -> DiagnosticArray:
        node = self._node
        values = {**node.intake.counts.as_dict(), **node.engine.statistics()}
        findings = [*node.intake.findings(node.now()), *node.engine.diagnose()]
        stamp = node.get_clock().now().to_msg()
        return messages.to_diagnostics(node.get_fully_qualified_name(), values, findings, stamp)
