"""Feed a recording to a map, one scan after the other, and count what happened."""

from __future__ import annotations

import time
from collections import Counter
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.io.recording import Frame

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap


class MappingRun:
    """A map that is being made from a recording, and its counts.

    What was mapped stays usable after any exception: `emap` holds the scans up to the last finished `add`.
    """

    def __init__(self, emap: ElevationMap) -> None:
        self.emap = emap
        self.counts: Counter[str] = Counter()  # points by what became of them, cells cleared by each stage
        self.num_points = 0
        self.update_ms: list[float] = []
        self.sensor_xy: list[NDArray[np.float64]] = []

    @property
    def num_scans(self) -> int:
        return len(self.update_ms)

    def center_on(self, position: NDArray[np.float64]) -> None:
        """Move the empty window onto a point (3,) [m] of the map frame: an update without points."""
        nothing = torch.full((1, 1, 3), torch.nan, device=self.emap.device)
        self.emap.update(nothing, self._pose(np.eye(4)), self._pose(translation(position)), dt=0.0)

    def add(self, frame: Frame, T_map_base: NDArray[np.float64] | None) -> None:
        """Fuse one scan. With `T_map_base` (4, 4) the window follows it, without it stays."""
        points = torch.from_numpy(frame.points)[None].to(self.emap.device)
        base = None if T_map_base is None else self._pose(T_map_base)
        start = time.perf_counter()
        self.emap.update(points, self._pose(frame.T_map_sensor), base, dt=frame.dt)
        self._count(len(frame.points))  # reads the statistics, which waits for a GPU to finish
        self.update_ms.append(1e3 * (time.perf_counter() - start))
        self.sensor_xy.append(frame.T_map_sensor[:2, 3])

    def _pose(self, matrix: NDArray[np.float64]) -> torch.Tensor:
        return torch.from_numpy(matrix)[None].to(self.emap.device)

    def _count(self, num_points: int) -> None:
        statistics = self.emap.statistics
        names = [name for name in statistics._fields if name.startswith(("points_", "rejected_", "cleared_"))]
        self.counts.update({name: int(getattr(statistics, name)[0]) for name in names})
        self.num_points += num_points


def base_poses(
    T_map_sensor: NDArray[np.float64], T_base_sensor: NDArray[np.float64] | None, sensor_height: float | None
) -> NDArray[np.float64]:
    """Where the robot stood at each scan, (T, 4, 4).

    From the sensor's mount `T_base_sensor` (4, 4) if it is known; else straight below the sensor by `sensor_height`
    [m], level and facing +x of the map; else at the sensor itself.
    """
    if T_base_sensor is not None:
        return T_map_sensor @ inverse(T_base_sensor)
    poses = np.tile(np.eye(4), (len(T_map_sensor), 1, 1))
    poses[:, :3, 3] = T_map_sensor[:, :3, 3] - [0.0, 0.0, sensor_height or 0.0]
    return poses


def inverse(transform: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverse of a rigid transform (4, 4), whose last row is 0 0 0 1 to the bit."""
    turned_back = transform[:3, :3].T
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = turned_back, -turned_back @ transform[:3, 3]
    return result


def translation(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """The transform (4, 4) that only moves to `position` (3,) [m]."""
    pose = np.eye(4)
    pose[:3, 3] = position
    return pose
