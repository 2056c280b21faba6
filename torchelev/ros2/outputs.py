"""What a node publishes, as plain values: their fields are those of the messages, but for the header. No ROS."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.grid_map import GridMap, grid_map_of
from torchelev.io.occupancy import OccupancyGrid, occupancy_of
from torchelev.levels.config import is_too_low, needed_height
from torchelev.robot_body.shapes import Box, Capsule
from torchelev.ros2.engine import Engine, Window
from torchelev.stages.measure.config import BodyConfig

_EARLY = 0.9  # part of a period after which an output may be made: looks at what is due are as far apart
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])  # quat_wxyz


class Topic(NamedTuple):
    """What is published on a topic."""

    type: str  #: of its messages
    is_latched: bool = False  #: late subscribers get the last message: transient local


#: below the node's name
TOPICS = {
    "map": Topic("grid_map_msgs/msg/GridMap", is_latched=True),
    "points": Topic("sensor_msgs/msg/PointCloud2"),
    "costmap": Topic("nav_msgs/msg/OccupancyGrid", is_latched=True),
    "height_scan": Topic("std_msgs/msg/Float32MultiArray"),
    "planes": Topic("visualization_msgs/msg/MarkerArray"),
    "polygons": Topic("geometry_msgs/msg/PolygonStamped"),
    "body": Topic("visualization_msgs/msg/MarkerArray", is_latched=True),
}
TRIGGERS = ("save_map", "load_map", "clear_map", "clear_around_robot", "initialize", "initialize_from_site")
#: below the node's name, with their types
SERVICES = dict.fromkeys(TRIGGERS, "std_srvs/srv/Trigger") | {
    "get_submap": "grid_map_msgs/srv/GetGridMap",
    "check_path": "nav2_msgs/srv/IsPathValid",
}


class MapCloud(NamedTuple):
    """Fields of a sensor_msgs/PointCloud2: x, y, z and the other layers, float32."""

    names: list[str]  #: of the fields
    data: NDArray[np.float32]  #: (N, len(names))


class Outline(NamedTuple):
    """A polygon of a planar region."""

    kind: str  #: "boundary", "hole", or "inset", where a foot may be put
    corners: NDArray[np.float64]  #: (K, 3) [m] map frame, the first not repeated


class Solid(NamedTuple):
    """A simple solid of the robot's body."""

    link: str  #: frame that it is fixed to
    kind: str  #: "box", "cylinder" along z, or "sphere"
    position: NDArray[np.float64]  #: (3,) [m] of its centre
    quat_wxyz: NDArray[np.float64]  #: (4,)
    size: tuple[float, float, float]  #: [m] along its own x, y and z


def grid_map(engine: Engine, layers: Sequence[str], area: Window | None = None) -> GridMap:
    """Return layers as a GridMap, of the cells in an area; None: of all."""
    window = engine.window()
    values = {name: engine.layer(name) for name in layers}
    if area is not None:
        rows, columns = area_cells(window, area)
        values = {name: layer[rows, columns] for name, layer in values.items()}
        corner = (window.corner[axis] + part.start * window.resolution for axis, part in enumerate((rows, columns)))
        shape = (rows.stop - rows.start, columns.stop - columns.start)
        window = Window(tuple(corner), window.resolution, shape)  # type: ignore[arg-type]
    basic = ["elevation"] if "elevation" in values else []
    return grid_map_of(values, window.center, window.resolution, basic)


def area_of(center: tuple[float, float], lengths: tuple[float, float], resolution: float) -> Window:
    """Return an area around a place [m]."""
    corner = (center[0] - 0.5 * lengths[0], center[1] - 0.5 * lengths[1])
    return Window(corner, resolution, (round(lengths[0] / resolution), round(lengths[1] / resolution)))


def area_cells(window: Window, area: Window) -> tuple[slice, slice]:
    """Return the rows and columns of a window in an area; ValueError if it has none."""
    first = [round((area.corner[k] - window.corner[k]) / window.resolution) for k in (0, 1)]
    parts = [slice(max(0, a), min(size, a + num)) for a, size, num in zip(first, window.shape, area.shape, strict=True)]
    if any(part.start >= part.stop for part in parts):
        center, corner = area.center, window.corner
        raise ValueError(f"the map, whose corner is at {corner} m, has no cells around {center} m")
    return parts[0], parts[1]


def make_outlines(regions: Sequence[Any]) -> list[Outline]:
    """Return the polygons of planar regions, the largest region first."""
    found = []
    for region in sorted(regions, key=lambda one: -one.area):
        found.append(Outline("boundary", region.boundary))
        found += [Outline("hole", hole) for hole in region.holes]
        found += [Outline("inset", inset) for inset in region.inset]
    return found


def make_solids(body: dict[str, Any] | None, base_frame: str) -> list[Solid]:
    """Return the shapes of a body, as the map's settings have it, as boxes, cylinders and spheres."""
    if body is None:
        return []
    if not {"capsules", "boxes"} & body.keys():
        box = BodyConfig(**body)
        lower, upper = np.array(box.lower), np.array(box.upper)
        return [Solid(base_frame, "box", (lower + upper) / 2, IDENTITY, tuple((upper - lower).tolist()))]
    capsules, boxes = (body.get(kind, ()) for kind in ("capsules", "boxes"))
    found = [_box(Box(**each)) for each in boxes]
    return found + [solid for each in capsules for solid in _capsule(Capsule(**each))]


def _box(box: Box) -> Solid:
    x, y, z = box.half_lengths
    return Solid(box.link, "box", np.array(box.center), np.array(box.quat_wxyz), (2 * x, 2 * y, 2 * z))


def _capsule(capsule: Capsule) -> list[Solid]:
    """Return a capsule as a cylinder and two spheres."""
    start, end, width = np.array(capsule.start), np.array(capsule.end), 2 * capsule.radius
    balls = [Solid(capsule.link, "sphere", place, IDENTITY, (width, width, width)) for place in (start, end)]
    if capsule.length < 1e-9:
        return balls[:1]
    turn = _from_z((end - start) / capsule.length)
    return [Solid(capsule.link, "cylinder", (start + end) / 2, turn, (width, width, capsule.length)), *balls]


def _from_z(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return quat_wxyz of the shortest rotation from z to a unit vector."""
    x, y, z = axis
    quat = np.array([1 + z, -y, x, 0.0]) if z > -1 + 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])
    return quat / np.linalg.norm(quat)


def costmap(engine: Engine, min_traversability: float, robot_height: float | None = None) -> OccupancyGrid:
    """Return the costs of the map at Nav2's scale, for a robot of a height [m]: `to_occupancy_grid`."""
    window, rating, needed = engine.window(), engine.layer("traversability"), needed_height(engine.levels, robot_height)
    low = None if engine.levels is None else is_too_low(engine.layer("clearance"), needed)
    return occupancy_of(rating, window.corner, window.resolution, min_traversability, low)


def map_cloud(engine: Engine, layers: Sequence[str]) -> MapCloud:
    """Return the known cells as points, with the other layers as fields."""
    window, elevation = engine.window(), engine.layer("elevation")
    i, j = np.nonzero(np.isfinite(elevation))
    others = [name for name in layers if name != "elevation"]
    place = [window.corner[axis] + (k + 0.5) * window.resolution for axis, k in enumerate((i, j))]
    columns = [*place, elevation[i, j], *(engine.layer(name)[i, j] for name in others)]
    return MapCloud(["x", "y", "z", *others], np.stack(columns, -1).astype(np.float32))


class Schedule:
    """When each output is due."""

    def __init__(self) -> None:
        self._last: dict[str, float] = {}

    def is_due(self, name: str, rate: float, now: float) -> bool:
        """Return whether an output of this rate [Hz] is due, and note that it is made."""
        if rate <= 0 or now - self._last.get(name, -1e18) < _EARLY / rate:
            return False
        last = self._last.get(name, now)
        # In step with the rate, unless more than a period was missed.
        self._last[name] = last + 1 / rate if 0 < now - last < 2 / rate else now
        return True
