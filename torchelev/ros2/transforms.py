"""Poses by tf2. Imports ROS."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.time import Time
from tf2_ros import Buffer, TransformException, TransformListener

from torchelev.ros2.messages import matrix_of

__all__ = ["TransformException", "Transforms"]
NEWEST = Time()  # tf2 takes time 0 as the newest transform


class Transforms:
    """What tf2 knows of frames in a fixed one.

    Args:
        node: which listens to /tf and /tf_static.
        map_frame: the fixed frame.
        on_arrival: called after transforms arrived.
    """

    def __init__(self, node: Node, map_frame: str, on_arrival: Callable[[], None]) -> None:
        self._buffer, self._map = Buffer(), map_frame
        self._listener = _Listener(self._buffer, node, on_arrival)

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
            if time is not None and self._buffer.can_transform(self._map, frame, time):
                found[k] = self.pose(frame, time)
        return found

    def forget(self) -> None:
        """Forget all transforms, as a clock jumped back."""
        self._buffer.clear()


class _Listener(TransformListener):
    """Listens to tf2, and says so."""

    def __init__(self, buffer: Buffer, node: Node, on_arrival: Callable[[], None]) -> None:
        self._on_arrival = on_arrival
        super().__init__(buffer, node)

    def callback(self, data: Any) -> None:
        """Take transforms of /tf."""
        super().callback(data)
        self._on_arrival()


def _shifted(stamp: Time, offset: float) -> Time | None:
    """Return the time at an offset [s] from a stamp; None before 0, where simulated time begins."""
    time = stamp.nanoseconds + round(1e9 * offset)
    return Time(nanoseconds=time, clock_type=stamp.clock_type) if time > 0 else None
