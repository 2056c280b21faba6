"""What a node publishes, as plain values: their fields are those of the messages, but for the header. No ROS."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.grid_map import GridMap, grid_map_of
from torchelev.io.occupancy import OccupancyGrid, occupancy_of
from torchelev.ros2.engine import Engine


class MapCloud(NamedTuple):
    """Fields of a sensor_msgs/PointCloud2: x, y, z and the other layers, float32."""

    names: list[str]  #: of the fields
    data: NDArray[np.float32]  #: (N, len(names))


def grid_map(engine: Engine, layers: Sequence[str]) -> GridMap:
    """Return layers as a GridMap."""
    window = engine.window()
    values = {name: engine.layer(name) for name in layers}
    basic = ["elevation"] if "elevation" in values else []
    return grid_map_of(values, window.center, window.resolution, basic)


def costmap(engine: Engine, min_traversability: float) -> OccupancyGrid:
    """Return the costs of the map at Nav2's scale."""
    window = engine.window()
    return occupancy_of(engine.layer("traversability"), window.corner, window.resolution, min_traversability)


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
        if rate <= 0 or now - self._last.get(name, -1e18) < 1 / rate - 1e-6:
            return False
        last = self._last.get(name, now)
        # In step with the rate, unless more than a period was missed.
        self._last[name] = last + 1 / rate if 0 < now - last < 2 / rate else now
        return True
