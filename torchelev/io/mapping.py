"""Feed a recording to a map scan by scan, and count what happens to its points."""

from __future__ import annotations

import time
from collections import Counter
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from torchelev.io.folders.recording import Frame
from torchelev.io.labels import LabelImage, to_probabilities

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap


COLOR, SEMANTIC = "rgb", "semantic"  # channels of the points' colours and of the images' labels


class MappingRun:
    """Build one map from a recording and keep statistics.

    The channel rgb of a map takes the colours of the points, and semantic the images of labels, where frames have them.
    If `add` raises, the map still holds all scans added before.

    Args:
        emap: the map to update; its first environment is used.

    Attributes:
        emap: the map.
        counts: number of points used and rejected, by reason, and of cells cleared, by stage, over all scans.
        num_points: points of all scans.
        update_ms: [ms] duration of each scan's update.
        sensor_xy: (2,) [m] position of the sensor at each scan, map frame.
    """

    def __init__(self, emap: ElevationMap) -> None:
        self.emap = emap
        self.counts: Counter[str] = Counter()
        self.num_points = 0
        self.update_ms: list[float] = []
        self.sensor_xy: list[NDArray[np.float64]] = []

    @property
    def num_scans(self) -> int:
        """The number of scans added so far."""
        return len(self.update_ms)

    def center_on(self, position: NDArray[np.float64]) -> None:
        """Move the empty window to a point (3,) [m] of the map frame, by an update without points."""
        no_points = torch.full((1, 1, 3), torch.nan, device=self.emap.device)
        T_map_base = np.eye(4)
        T_map_base[:3, 3] = position
        self.emap.update(no_points, self._to_tensor(np.eye(4)), self._to_tensor(T_map_base), dt=0.0)

    def add(self, frame: Frame, T_map_base: NDArray[np.float64] | None) -> None:
        """Fuse one scan.

        Args:
            frame: the scan.
            T_map_base: (4, 4) pose of the robot's base, which the window follows; None: the window stays.
        """
        points = torch.from_numpy(frame.points)[None].to(self.emap.device)
        base = None if T_map_base is None else self._to_tensor(T_map_base)
        start = time.perf_counter()
        covariance = None if frame.pose_covariance is None else self._to_tensor(frame.pose_covariance)
        T_map_sensor, colors = self._to_tensor(frame.T_map_sensor), self._colors(frame)
        self.emap.update(points, T_map_sensor, base, dt=frame.dt, pose_covariance=covariance, features=colors)
        self._count(len(frame.points))  # reading the statistics waits for a GPU to finish
        self.update_ms.append(1e3 * (time.perf_counter() - start))
        self.sensor_xy.append(frame.T_map_sensor[:2, 3].copy())  # a view would keep what the pose was computed from
        for image in frame.images:
            self._paint(image)

    def _colors(self, frame: Frame) -> dict[str, torch.Tensor] | None:
        """Return what the points bring for the channel of colours; None: nothing, or there is none."""
        if frame.colors is None or COLOR not in self.emap.cfg.channels:
            return None
        return {COLOR: torch.from_numpy(frame.colors)[None].to(self.emap.device)}

    def _paint(self, image: LabelImage) -> None:
        if SEMANTIC in self.emap.cfg.channels:
            num_classes, K = self.emap.cfg.channels[SEMANTIC].size, self._to_tensor(image.K)
            pixels = torch.from_numpy(to_probabilities(image.labels, num_classes))[None].to(self.emap.device)
            T, lens = self._to_tensor(image.T_map_camera), image.distortion or None
            self.emap.paint(pixels, K, T, SEMANTIC, distortion=lens, mode="nearest")

    def _to_tensor(self, pose: NDArray[np.float64]) -> torch.Tensor:
        return torch.from_numpy(pose)[None].to(self.emap.device)

    def _count(self, num_points: int) -> None:
        statistics = self.emap.statistics
        names = [name for name in statistics._fields if name.startswith(("points_", "rejected_", "cleared_"))]
        self.counts.update({name: int(getattr(statistics, name)[0]) for name in names})
        self.num_points += num_points


def base_poses(
    T_map_sensor: NDArray[np.float64], T_base_sensor: NDArray[np.float64] | None, sensor_height: float | None
) -> NDArray[np.float64]:
    """Return the poses of the robot's base at each scan: T_map_base = T_map_sensor (T_base_sensor)^-1.

    Args:
        T_map_sensor: (T, 4, 4) poses of the sensor.
        T_base_sensor: (4, 4) pose of the sensor on the robot. If None, the base is taken to be level, aligned with the
            map frame, and straight below the sensor.
        sensor_height: [m] of the sensor above the base, read if T_base_sensor is None; None: 0.

    Returns:
        T_map_base, (T, 4, 4).
    """
    if T_base_sensor is not None:
        return T_map_sensor @ _invert(T_base_sensor)
    poses = np.tile(np.eye(4), (len(T_map_sensor), 1, 1))
    poses[:, :3, 3] = T_map_sensor[:, :3, 3] - [0.0, 0.0, sensor_height or 0.0]
    return poses


def _invert(transform: NDArray[np.float64]) -> NDArray[np.float64]:
    """Invert a rigid transform (4, 4); unlike np.linalg.inv, this keeps the last row 0 0 0 1 exact."""
    rotation = transform[:3, :3].T
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = rotation, -rotation @ transform[:3, 3]
    return inverse
