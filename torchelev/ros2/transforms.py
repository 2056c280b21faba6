"""Poses by tf2. Imports ROS."""

from __future__ import annotations

from contextlib import suppress
from threading import Thread

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.time import Time
from tf2_ros import Buffer, TransformException, TransformListener

from torchelev.ros2.messages import matrix_of

__all__ = ["TransformException", "Transforms"]
NEWEST = Time()  # tf2 takes time 0 as the newest transform


class Transforms:
    """What tf2 knows of frames in a fixed one.

    Args:
        node: beside which another one listens to /tf and /tf_static.
        map_frame: the fixed frame.
    """

    def __init__(self, node: Node, map_frame: str) -> None:
        self._buffer, self._map = Buffer(), map_frame
        # A thread and a node of its own: robots send hundreds of transforms a second, also while the map is updated.
        arguments = ["--ros-args", "-r", f"__node:={node.get_name()}_tf"]  # not the name that the node was given
        self._node = Node(f"{node.get_name()}_tf", namespace=node.get_namespace(), cli_args=arguments)
        self._listener = TransformListener(self._buffer, self._node)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._thread = Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except Exception:
            if rclpy.ok():  # else it was shut down in the middle of its work
                raise

    def has(self, frame: str, stamp: Time, offset: float = 0.0, parent: str = "") -> bool:
        """Return whether the pose of a frame is known at a stamp, or an offset [s] from it."""
        time = _shifted(stamp, offset)
        return time is not None and self._buffer.can_transform(parent or self._map, frame, time)

    def pose(self, frame: str, stamp: Time = NEWEST, parent: str = "") -> NDArray[np.float64]:
        """Return T_parent_frame (4, 4) at a stamp; TransformException if it is not known. The parent is the map."""
        return matrix_of(self._buffer.lookup_transform(parent or self._map, frame, stamp).transform)

    def poses(self, frame: str, stamp: Time, offsets: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return T_map_frame (M, 4, 4) at offsets (M,) [s] from a stamp, NaN where it is not known."""
        found = np.full((len(offsets), 4, 4), np.nan)
        for k, offset in enumerate(offsets.tolist()):
            time = _shifted(stamp, offset)
            if time is None:
                continue
            with suppress(TransformException):
                found[k] = self.pose(frame, time)
        return found

    def close(self) -> None:
        """Stop listening."""
        self._executor.shutdown()
        self._thread.join(timeout=2.0)
        self._node.destroy_node()

    def forget(self) -> None:
        """Forget all transforms, as a clock jumped back."""
        self._buffer.clear()


def _shifted(stamp: Time, offset: float) -> Time | None:
    """Return the time at an offset [s] from a stamp; None before 0, where simulated time begins."""
    time = stamp.nanoseconds + round(1e9 * offset)
    return Time(nanoseconds=time, clock_type=stamp.clock_type) if time > 0 else None
