"""Traversability as a nav_msgs/OccupancyGrid for Nav2, without importing ROS."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.errors import require
from torchelev.io.grid_map import Point, Pose
from torchelev.levels.config import is_too_low, needed_height

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap

UNKNOWN, LETHAL = -1, 100
_HIGHEST = 98  # 99 stands for Nav2's inscribed obstacle, which a costmap computes itself


class MapMetaData(NamedTuple):
    """Same fields as nav_msgs/MapMetaData, except for the time."""

    resolution: float  #: [m]
    width: int  #: number of cells along x
    height: int  #: number of cells along y
    origin: Pose  #: of the corner of the cell with the smallest x and y


class OccupancyGrid(NamedTuple):
    """Same fields as nav_msgs/OccupancyGrid, except for the header."""

    info: MapMetaData  #: resolution, size and place
    data: NDArray[np.int8]  #: (W * H,), x fastest: -1 unknown, 0 free to 100 lethal


def to_occupancy_grid(
    emap: ElevationMap, env: int = 0, min_traversability: float = 0.5, height: float | None = None
) -> OccupancyGrid:
    """Turn the traversability t of one environment into the costs of Nav2's costmaps.

    Below `min_traversability` a cell is lethal, 100. Above, its cost falls from 98 to 0, 98 (1 - t) / (1 - min). 99,
    Nav2's inscribed obstacle, is left to its inflation layer. Cells that are not rated are unknown, -1. On maps with
    levels, cells below a ceiling that is too low for the robot are lethal, whatever their rating.

    Args:
        emap: the map.
        env: the environment.
        min_traversability: t below which the robot must not stand, from 0 to less than 1.
        height: of the robot [m], on maps with levels; None: their `min_gap`, and at least that.

    Raises:
        ValueError: the environment does not exist, `min_traversability` is out of range, or a height is given for a
            map without levels.
    """
    from torchelev.io.export import take  # which needs PyTorch

    require_threshold(min_traversability)
    needed = needed_height(emap.cfg.levels, height)
    taken = take(emap, env, ("traversability",) if emap.levels is None else ("traversability", "clearance"))
    x_min, _, y_min, _ = taken.extent
    low = None if emap.levels is None else is_too_low(taken.layers["clearance"], needed)
    return occupancy_of(taken.layers["traversability"], (x_min, y_min), taken.resolution, min_traversability, low)


def require_threshold(min_traversability: float) -> None:
    """Refuse a threshold that is no traversability below 1."""
    in_range, hint = 0 <= min_traversability < 1, "the default is 0.5"
    require(in_range, "min_traversability", "must be at least 0 and less than 1", min_traversability, hint)


def occupancy_of(
    traversability: NDArray,
    corner: Sequence[float],
    resolution: float,
    min_traversability: float = 0.5,
    too_low: NDArray[np.bool_] | None = None,
) -> OccupancyGrid:
    """Return the costs of a layer (H, W), NaN where not rated: `to_occupancy_grid`.

    Args:
        traversability: in [0, 1].
        corner: x, y [m] of the window's corner with the smallest coordinates.
        resolution: [m] of a cell.
        min_traversability: below which the robot must not stand.
        too_low: (H, W) where the robot does not fit below a ceiling; None: nowhere.
    """
    t = traversability
    cost = np.round(_HIGHEST * (1 - t) / (1 - min_traversability))
    cost = np.where(t < min_traversability, LETHAL, cost)
    cost = np.where(np.isnan(t), UNKNOWN, cost)
    data = (cost if too_low is None else np.where(too_low, LETHAL, cost)).astype(np.int8)
    info = MapMetaData(resolution, t.shape[0], t.shape[1], Pose(Point(float(corner[0]), float(corner[1]))))
    return OccupancyGrid(info, np.ascontiguousarray(data.T).ravel())
