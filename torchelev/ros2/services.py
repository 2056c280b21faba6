"""What a node serves. Imports ROS."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from torchelev.errors import require
from torchelev.ros2 import messages, outputs
from torchelev.ros2.settings import read_footprint
from torchelev.ros2.transforms import NEWEST, TransformException

if TYPE_CHECKING:
    from torchelev.ros2.node import ElevationMappingNode

_ERRORS = (ValueError, OSError, ImportError, TransformException)  # of a request, which must not end the node


class Services:
    """The services of a node: those without values are Triggers, whose values are the node's parameters."""

    def __init__(self, node: ElevationMappingNode) -> None:
        self._node = node
        acts = (self.save, self.load, self._forget, self._clear_around, self._initialize, self._initialize_from_site)
        for name, act in zip(outputs.TRIGGERS, acts, strict=True):
            node.create_service(Trigger, f"~/{name}", _trigger(act))
        self._serve_submaps()
        self._serve_path_checks()

    # Triggers --------------------------------------------------------------------------------------------------------

    def save(self) -> str:
        """Save the map."""
        path = Path(self._node.settings.map_file)
        self._node.engine.save(path)
        return f"saved {path.absolute()}"

    def load(self) -> str:
        """Load a map."""
        path = Path(self._node.settings.map_file)
        self._node.engine.load(path)
        self._node.stamp_now()
        return f"loaded {path.absolute()}"

    def _forget(self) -> str:
        self._node.engine.reset()
        return "the map is empty"

    def _clear_around(self) -> str:
        settings = self._node.settings
        x, y = self._node.transforms.pose(settings.base_frame)[:2, 3]
        self._node.engine.clear_around(np.array([x, y]), settings.clear_radius)
        return f"cleared {settings.clear_radius:g} m around x = {x:.2f} m, y = {y:.2f} m"

    def _initialize(self) -> str:
        settings = self._node.settings
        if not settings.feet:
            raise ValueError("feet: must name the frames of the feet, got none; set the parameter feet")
        places = np.array([self._node.transforms.pose(name)[:3, 3] for name in settings.feet])
        T_map_base = self._node.transforms.pose(settings.base_frame)
        self._node.engine.initialize(places - [0, 0, settings.foot_height], settings.initialize_method, T_map_base)
        if not np.isfinite(self._node.engine.layer("elevation")).any():
            raise ValueError("feet: must stand in the map's window, got none of its cells; check base_frame and feet")
        self._node.stamp_now()
        return f"the ground below {', '.join(settings.feet)} is in the map"

    def _initialize_from_site(self) -> str:
        settings = self._node.settings
        if not settings.site:
            raise ValueError("site: must be the folder of a site map, got none; set the parameter site")
        self._node.engine.initialize_from(Path(settings.site), self._node.transforms.pose(settings.base_frame))
        self._node.stamp_now()
        return f"the map has what {settings.site} knows"

    # Others ----------------------------------------------------------------------------------------------------------

    def _serve_submaps(self) -> None:
        try:
            from grid_map_msgs.srv import GetGridMap
        except ModuleNotFoundError:  # `Publishers` says so
            return
        self._node.create_service(GetGridMap, "~/get_submap", self._guarded(self._get_submap))

    def _serve_path_checks(self) -> None:
        try:
            from nav2_msgs.srv import IsPathValid
        except ModuleNotFoundError:
            self._node.get_logger().info("no nav2_msgs: ~/check_path is not served; install ros-$ROS_DISTRO-nav2-msgs")
            return
        self._node.create_service(IsPathValid, "~/check_path", self._guarded(self._check_path))

    def _guarded(self, act: Callable[[Any, Any], None]) -> Callable[[Any, Any], Any]:
        """Return a callback that answers with what `act` filled in; its errors are logged, the answer is empty then."""

        def call(request: Any, response: Any) -> Any:
            try:
                act(request, response)
            except _ERRORS as error:
                self._node.get_logger().error(_text_of(error))
            return response

        return call

    def _get_submap(self, request: Any, response: Any) -> None:
        self._require_frame(request.frame_id)
        resolution = self._node.engine.window().resolution
        center, lengths = (request.position_x, request.position_y), (request.length_x, request.length_y)
        hint = "give metres in the map's frame"
        require(all(map(math.isfinite, (*center, *lengths))), "request", "must be finite", (center, lengths), hint)
        require(min(lengths) > 0, "length_x, length_y", "must be positive", lengths, hint)
        area = outputs.area_of(center, lengths, resolution)
        layers = list(request.layers) or self._node.settings.layers
        grid = outputs.grid_map(self._node.engine, layers, area)
        stamp = self._node.stamp or self._node.get_clock().now().to_msg()
        header = Header(frame_id=self._node.settings.map_frame, stamp=stamp)
        response.map = messages.to_grid_map(grid, header)

    def _check_path(self, request: Any, response: Any) -> None:
        response.is_valid = False
        self._require_frame(request.path.header.frame_id)
        poses = np.array([messages.xy_yaw_of(one.pose) for one in request.path.poses]).reshape(-1, 3)
        require(len(poses) > 0, "path", "must have a pose", "none", "the planner found no path")
        require(bool(np.isfinite(poses).all()), "path", "must be finite", "NaN or inf", "check the planner")
        settings, transforms = self._node.settings, self._node.transforms
        is_placed = transforms.has(settings.base_frame, NEWEST)
        T_map_base = transforms.pose(settings.base_frame) if is_placed else None
        checked = self._node.engine.check_path(poses, np.array(read_footprint(settings.footprint)), T_map_base)
        response.is_valid, response.invalid_pose_indices = checked.is_safe, checked.unsafe
        self._node.get_logger().info(f"check_path: {checked.reason}")

    def _require_frame(self, frame: str) -> None:
        expected = self._node.settings.map_frame
        hint = "transform it first, or leave it empty"
        require(frame in ("", expected), "frame_id", f"must be {expected}", repr(frame), hint)


def _trigger(act: Callable[[], str]) -> Callable[[Any, Any], Any]:
    """Return the callback of a Trigger: the sentence that `act` returns, or that of its error."""

    def call(_: Any, response: Any) -> Any:
        try:
            response.success, response.message = True, act()
        except _ERRORS as error:
            response.success, response.message = False, _text_of(error)
        return response

    return call


def _text_of(error: Exception) -> str:
    is_file = isinstance(error, OSError) and error.filename is not None and error.strerror is not None
    return f"{error.filename}: {error.strerror.lower()}" if is_file else str(error)  # type: ignore[attr-defined]
