"""The node's parameters, from a YAML file and from ROS."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import Any

from torchelev.errors import require, require_positive
from torchelev.files.config_files import read_settings
from torchelev.levels.config import MAX_HEIGHT

_KINDS = {str: "text", float: "a number", int: "a whole number", bool: "true or false"}
_OF_ROS = ("use_sim_time", "qos_overrides", "start_type_description_service")  # parameters that rclpy declares
ENGINES = ("auto", "torch", "library")
_HIGHEST = 1000.0  # rate [Hz], and wait [s]
_METHODS = ("linear", "nearest")  # of `ElevationMap.initialize`


def _setting(default: Any, meaning: str, changeable: bool = False) -> Any:
    """Return a field with its meaning, as `ros2 param describe` shows it."""
    return field(default=default, metadata={"meaning": meaning, "changeable": changeable})


@dataclass(frozen=True, kw_only=True)
class NodeSettings:
    """Parameters of the node. Those that are changeable may be set while it runs.

    Raises:
        ValueError: a value has the wrong type or is out of range.
    """

    map_frame: str = _setting("odom", "fixed frame of the map, z up; use one that does not jump, such as odom")
    base_frame: str = _setting("base_link", "frame that the map's window follows")
    clouds: tuple[str, ...] = _setting(("points",), "topics of sensor_msgs/PointCloud2")
    depths: tuple[str, ...] = _setting((), "topics of sensor_msgs/Image: depth, 16UC1 or 32FC1")
    camera_infos: tuple[str, ...] = _setting((), "their sensor_msgs/CameraInfo; empty: camera_info beside each depth")
    depth_scale: float = _setting(0.0, "[m] per unit of depth; 0: that of the encoding, millimetres or metres")
    odometry: str = _setting("", "topic of nav_msgs/Odometry, whose covariance is that of the base's pose; empty: none")
    deskew: bool = _setting(True, "take motion within a scan out of clouds that have a time for each point", True)
    reliable: bool = _setting(False, "subscribe to sensors reliably, which their publishers may not offer")
    transform_wait: float = _setting(0.2, "[s] that a cloud waits for the transforms of its points")
    rate_map: float = _setting(2.0, "[Hz] of ~/map, a grid_map_msgs/GridMap; 0: never", True)
    rate_points: float = _setting(1.0, "[Hz] of ~/points, the map as a sensor_msgs/PointCloud2; 0: never", True)
    rate_costmap: float = _setting(1.0, "[Hz] of ~/costmap, a nav_msgs/OccupancyGrid; 0: never", True)
    rate_planes: float = _setting(1.0, "[Hz] of ~/planes and ~/polygons, planar regions; 0: never; needs PyTorch", True)
    rate_height_scan: float = _setting(50.0, "[Hz] of ~/height_scan, a std_msgs/Float32MultiArray; 0: never", True)
    rate_diagnostics: float = _setting(1.0, "[Hz] of /diagnostics; 0: never", True)
    layers: tuple[str, ...] = _setting(
        ("elevation", "variance", "traversability", "upper_bound"),
        "layers of ~/map and of ~/points, where elevation is z",
        True,
    )
    min_traversability: float = _setting(0.5, "in [0, 1): below it a cell of ~/costmap is lethal", True)
    robot_height: float = _setting(
        0.0, "[m] on maps with levels, ~/costmap and ~/check_path close spaces below lower ceilings; 0: their min_gap"
    )
    height_scan: str = _setting("isaac_lab", "layout of ~/height_scan: isaac_lab, mjlab, legged_gym, or one as JSON")
    map_file: str = _setting(
        "map.safetensors", "file of ~/save_map and ~/load_map, from the folder of the start on", True
    )
    load_on_start: bool = _setting(False, "load map_file when the node starts, if it is there")
    clear_radius: float = _setting(1.5, "[m] around base_frame that ~/clear_around_robot forgets", True)
    feet: tuple[str, ...] = _setting((), "frames of the feet; ~/initialize starts the map from the ground below them")
    foot_height: float = _setting(0.0, "[m] of the feet's frames over the ground that they stand on", True)
    initialize_method: str = _setting("linear", "of ~/initialize: linear within the feet, or nearest everywhere", True)
    site: str = _setting("", "folder of a site map that ~/initialize_from_site starts from; needs PyTorch", True)
    footprint: str = _setting(
        "[[0.35, 0.25], [0.35, -0.25], [-0.35, -0.25], [-0.35, 0.25]]",
        "[m] corners in base_frame, a text as in Nav2, which ~/check_path moves along a path; needs PyTorch",
        True,
    )
    engine: str = _setting("auto", "torch, library (libtorchelev, without PyTorch), or auto: torch if it is installed")
    library: str = _setting("", "path of libtorchelev; empty: that of the wheel, or the system's")
    threads: int = _setting(1, "threads that share an update")
    max_points: int = _setting(200_000, "points of a cloud at most; of larger ones every k-th is used")

    def __post_init__(self) -> None:
        for each in dataclasses.fields(self):
            object.__setattr__(self, each.name, _checked(each.name, getattr(self, each.name), each.default))
        for name, value in vars(self).items():
            if name.startswith("rate_") or name == "transform_wait":
                hint = "give seconds" if name == "transform_wait" else "give Hz; 0: never"
                require(0 <= value <= _HIGHEST, name, f"must lie in [0, {_HIGHEST:g}]", value, hint)
        in_range = 0 <= self.min_traversability < 1
        require(in_range, "min_traversability", "must lie in [0, 1)", self.min_traversability, "the default is 0.5")
        require(self.engine in ENGINES, "engine", f"must be one of {', '.join(ENGINES)}", repr(self.engine), "use auto")
        for name in ("depth_scale", "foot_height"):
            require(math.isfinite(getattr(self, name)), name, "must be finite", getattr(self, name), "see its default")
        height_fits = 0 <= self.robot_height <= MAX_HEIGHT
        rule = f"must lie in [0, {MAX_HEIGHT:g}] m"
        require(height_fits, "robot_height", rule, self.robot_height, "give metres; 0: min_gap of the levels")
        require(self.depth_scale >= 0, "depth_scale", "must not be negative", self.depth_scale, "0.001 for millimetres")
        require_positive(clear_radius=self.clear_radius)
        is_method = self.initialize_method in _METHODS
        rule = f"must be one of {', '.join(_METHODS)}"
        require(is_method, "initialize_method", rule, repr(self.initialize_method), "use linear")
        num, expected = len(self.camera_infos), len(self.depths)
        rule, hint = f"must be none, or one for each of {expected} topics in depths", "give them in their order"
        require(num in (0, expected), "camera_infos", rule, num, hint)
        for name in ("map_frame", "base_frame"):
            object.__setattr__(self, name, getattr(self, name).lstrip("/"))  # as tf2 names frames
        topics = (*self.clouds, *self.depths)
        is_once, hint = len(set(topics)) == len(topics), "name each once"
        require(is_once, "clouds, depths", "must not repeat a topic", ", ".join(topics), hint)
        sensors = bool(self.clouds or self.depths)
        require(sensors, "clouds", "must not be empty without depths", repr(self.clouds), "name a topic")
        read_footprint(self.footprint)
        for name in ("threads", "max_points"):
            require(getattr(self, name) >= 1, name, "must be at least 1", getattr(self, name), "see its default")
        for name in ("map_frame", "base_frame", "layers", "map_file"):
            require(bool(getattr(self, name)), name, "must not be empty", repr(getattr(self, name)), "name one")
        for name in ("clouds", "depths", "camera_infos", "layers", "feet"):
            value = getattr(self, name)
            require(all(value), name, "must not have an empty name", list(value), "leave it out")


def _checked(name: str, value: Any, default: Any) -> Any:
    """Return a value of the default's type; whole numbers are floats, too, and lists are tuples."""
    if isinstance(default, tuple):
        is_list = isinstance(value, list | tuple) and all(isinstance(item, str) for item in value)
        require(is_list, name, "must be a list of names", repr(value), "write [name, name]")
        return tuple(value)
    is_number = isinstance(value, Real) and not isinstance(value, bool)
    if isinstance(default, float) and is_number:
        return float(value)
    kind = type(default)
    rule = f"must be {_KINDS[kind]}"
    require(type(value) is kind, name, rule, repr(value), f"such as {default!r}")
    return value


def read_footprint(text: str) -> list[list[float]]:
    """Return the corners (V, 2) [m] of a footprint as Nav2 writes it, "[[x, y], ...]"; ValueError for another text."""
    hint = 'write "[[0.3, 0.2], [0.3, -0.2], [-0.3, 0.0]]"'
    try:
        corners = json.loads(text)
        numbers = [value for corner in corners for value in corner]
        is_polygon = len(corners) >= 3 and all(len(corner) == 2 for corner in corners)
        is_finite = all(type(value) in (int, float) and math.isfinite(value) for value in numbers)
    except (ValueError, TypeError):
        is_polygon = is_finite = False
    require(is_polygon and is_finite, "footprint", "must be three or more corners of two numbers", repr(text), hint)
    pairs = zip(corners, corners[1:] + corners[:1], strict=True)
    area = 0.5 * abs(sum(a[0] * b[1] - b[0] * a[1] for a, b in pairs))
    require(area > 1e-6, "footprint", "must have an area", repr(text), hint)
    return [[float(value) for value in corner] for corner in corners]


def read_node_file(path: str | Path) -> tuple[NodeSettings, dict[str, Any]]:
    """Read a YAML file: the node's parameters, and below `map` the settings of the map.

    A file of ROS, `node_name: {ros__parameters: {...}}`, is read, too.

    Raises:
        ValueError: the file cannot be read, or has a parameter that does not exist or does not fit.
    """
    values = read_settings(path)
    inner = next(iter(values.values())) if len(values) == 1 else None
    if isinstance(inner, dict) and isinstance(inner.get("ros__parameters"), dict):
        values = inner["ros__parameters"]
    try:
        settings, cfg = split(values)
        return make_settings(settings), cfg
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def split(values: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the node's parameters and the map's settings."""
    cfg = values.get("map") or {}
    require(isinstance(cfg, dict), "map", "must be the settings of a map", repr(cfg), "write map: {grid: {...}}")
    return {name: value for name, value in values.items() if name != "map" and not is_of_ros(name)}, cfg


def is_of_ros(name: str) -> bool:
    """Return whether rclpy declares a parameter itself."""
    return name.partition(".")[0] in _OF_ROS


def nest(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested dicts from names with points between, as ROS has them."""
    root: dict[str, Any] = {}
    for name, value in values.items():
        *groups, last = name.split(".")
        group = root
        for each in groups:
            group = group.setdefault(each, {})
        group[last] = value
    return root


def make_settings(values: Mapping[str, Any]) -> NodeSettings:
    """Return settings from a mapping by name; ValueError for one that does not exist."""
    names = [each.name for each in dataclasses.fields(NodeSettings)]
    for name in values:
        require(name in names, name, "is no parameter", repr(name), f"there are map, {', '.join(names)}")
    return NodeSettings(**values)


def list_changeable() -> set[str]:
    """Return the names of the parameters that may change while the node runs."""
    return {each.name for each in dataclasses.fields(NodeSettings) if each.metadata["changeable"]}
