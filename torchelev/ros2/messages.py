"""ROS messages of a node's outputs, and matrices of its transforms. Imports ROS."""

from __future__ import annotations

import math
from array import array
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Point32, Polygon, PolygonStamped
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Float32MultiArray, Header, MultiArrayDimension
from visualization_msgs.msg import Marker, MarkerArray

from torchelev.frames.quaternions import to_rotation
from torchelev.io import grid_map as plain
from torchelev.io import occupancy
from torchelev.ros2.outputs import MapCloud, Outline, Solid

# Colours of markers, red green blue alpha.
_COLOURS = {"boundary": (0.1, 0.6, 0.9, 1.0), "hole": (0.9, 0.2, 0.1, 1.0), "inset": (0.1, 0.8, 0.3, 1.0)}
_BODY = (0.9, 0.6, 0.1, 0.5)
_SOLIDS = {"box": Marker.CUBE, "cylinder": Marker.CYLINDER, "sphere": Marker.SPHERE}


def matrix_of(transform: Any) -> NDArray[np.float64]:
    """Return the matrix (4, 4) of a geometry_msgs/Transform."""
    p, q = transform.translation, transform.rotation
    quat = np.array([q.w, q.x, q.y, q.z])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = to_rotation(quat / np.linalg.norm(quat)), (p.x, p.y, p.z)
    return T


def xy_yaw_of(pose: Any) -> tuple[float, float, float]:
    """Return x, y [m] and the heading [rad] of a geometry_msgs/Pose."""
    q = pose.orientation
    heading = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
    return pose.position.x, pose.position.y, heading


def to_occupancy_grid(grid: occupancy.OccupancyGrid, header: Header) -> OccupancyGrid:
    """Return the message of a costmap."""
    message = OccupancyGrid(header=header, data=array("b", grid.data.tobytes()))
    info, origin = message.info, grid.info.origin.position
    info.map_load_time, info.resolution = header.stamp, grid.info.resolution
    info.width, info.height = grid.info.width, grid.info.height
    info.origin.position.x, info.origin.position.y = origin.x, origin.y
    info.origin.orientation.w = 1.0
    return message


def to_cloud(cloud: MapCloud, header: Header) -> PointCloud2:
    """Return the message of the map's cells as points."""
    number, width = len(cloud.data), len(cloud.names)
    fields = [
        PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1) for k, name in enumerate(cloud.names)
    ]
    sizes = {"height": 1, "width": number, "point_step": 4 * width, "row_step": 4 * width * number}
    data = array("B", cloud.data.tobytes())
    return PointCloud2(header=header, fields=fields, is_bigendian=False, is_dense=True, data=data, **sizes)


def to_scan(values: NDArray[np.float32], layout: str) -> Float32MultiArray:
    """Return the message of a height scan; its dimension is named after the layout."""
    message = Float32MultiArray(data=array("f", values.tobytes()))
    message.layout.dim = [MultiArrayDimension(label=layout, size=len(values), stride=len(values))]
    return message


def to_grid_map(grid: plain.GridMap, header: Header) -> Any:
    """Return the message of a GridMap; ModuleNotFoundError without grid_map_msgs."""
    from grid_map_msgs.msg import GridMap

    message = GridMap(header=header, layers=grid.layers, basic_layers=grid.basic_layers)
    info, center = message.info, grid.info.pose.position
    info.resolution, info.length_x, info.length_y = grid.info.resolution, grid.info.length_x, grid.info.length_y
    info.pose.position.x, info.pose.position.y, info.pose.orientation.w = center.x, center.y, 1.0
    for layer in grid.data:
        entry = Float32MultiArray(data=array("f", layer.data.tobytes()))
        entry.layout.dim = [MultiArrayDimension(**one._asdict()) for one in layer.layout.dim]
        message.data.append(entry)
    return message


def to_plane_markers(outlines: list[Outline], header: Header) -> MarkerArray:
    """Return the outlines of planar regions as lines, which replace those before."""
    markers = [Marker(header=header, action=Marker.DELETEALL)]
    for number, one in enumerate(outlines):
        marker = Marker(
            header=header, ns=one.kind, id=number, type=Marker.LINE_STRIP, color=_colour(_COLOURS[one.kind])
        )
        marker.pose.orientation.w, marker.scale.x = 1.0, 0.01  # [m] width of the line
        marker.points = [Point(x=x, y=y, z=z) for x, y, z in (*one.corners.tolist(), one.corners[0].tolist())]
        markers.append(marker)
    return MarkerArray(markers=markers)


def to_polygon(outline: Outline, header: Header) -> PolygonStamped:
    """Return the corners of an outline."""
    corners = [Point32(x=x, y=y, z=z) for x, y, z in outline.corners.tolist()]
    return PolygonStamped(header=header, polygon=Polygon(points=corners))


def to_body_markers(solids: list[Solid]) -> MarkerArray:
    """Return the robot's shapes, each in the frame of its link, with which it moves."""
    markers = []
    for number, one in enumerate(solids):
        marker = Marker(ns="body", id=number, type=_SOLIDS[one.kind], color=_colour(_BODY), frame_locked=True)
        marker.header.frame_id = one.link
        place, turn, size = marker.pose.position, marker.pose.orientation, marker.scale
        place.x, place.y, place.z = one.position.tolist()
        turn.w, turn.x, turn.y, turn.z = one.quat_wxyz.tolist()
        size.x, size.y, size.z = one.size
        markers.append(marker)
    return MarkerArray(markers=markers)


def _colour(rgba: tuple[float, float, float, float]) -> ColorRGBA:
    r, g, b, a = rgba
    return ColorRGBA(r=r, g=g, b=b, a=a)


def to_diagnostics(name: str, values: dict[str, Any], findings: list[str], stamp: Time) -> DiagnosticArray:
    """Return a status: OK, or WARN with what looks wrong."""
    level = DiagnosticStatus.WARN if findings else DiagnosticStatus.OK
    entries = [
        KeyValue(key=key, value=str(value) if isinstance(value, int) else f"{value:g}") for key, value in values.items()
    ]
    entries += [KeyValue(key=f"finding {k}", value=text) for k, text in enumerate(findings)]
    text = findings[0] if findings else "nothing looks wrong"
    status = DiagnosticStatus(level=level, name=name, message=text, hardware_id="torchelev", values=entries)
    return DiagnosticArray(header=Header(stamp=stamp), status=[status])
