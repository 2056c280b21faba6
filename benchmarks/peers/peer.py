"""What a peer is: a class `Map` in a file of `benchmarks/peers/maps`, which runs in a process of its own.

The class says its `TITLE`, its `SETTINGS`, the module that it `NEEDS` ("" for none), and what it `TAKES`: "points", or
"depth" where it takes depth images alone. Such files import NumPy and the peer's package, and nothing of torchelev but
this file. `benchmarks/peers/program.py` is for peers that are programs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

Array = Any  # numpy.ndarray: typed arrays would need a later NumPy than some peers bring


@dataclass
class Setup:
    """What is known before the first scan."""

    resolution: float  #: [m] side of a cell, and of a voxel
    low: tuple[float, float]  #: [m] corner of the mapped area, map frame
    cells: tuple[int, int]  #: of the mapped area along x and y
    max_range: float  #: [m] of the sensor
    sensor_height: float  #: [m] over the ground at the start
    pinhole: tuple[int, int, float, float, float, float] | None  #: width, height, fx, fy, cx, cy of a depth camera


@dataclass
class Frame:
    """A scan."""

    points: Array  #: (N, 3) float32 [m], sensor frame: x forward, y left, z up; NaN where a pixel saw nothing
    T_map_sensor: Array  #: (4, 4) float64
    T_map_base: Array  #: (4, 4) float64
    dt: float  #: [s] since the scan before

    def placed(self) -> Array:
        """Return the points that are there, in the map frame, float64."""
        points = self.points[np.isfinite(self.points).all(1)].astype(np.float64)
        return points @ self.T_map_sensor[:3, :3].T + self.T_map_sensor[:3, 3]


class Peer(Protocol):
    """A map that is compared."""

    TITLE: str
    SETTINGS: str
    NEEDS: str
    TAKES: str

    def __init__(self, setup: Setup) -> None: ...

    def update(self, frame: Frame) -> None:
        """Take in a scan: this is timed."""

    def ground(self) -> tuple[Array, Array | None]:
        """Return the height of the ground [m] at each cell, NaN where unknown, and its standard deviation or None."""


class Cells:
    """Numbers the cells of the mapped area, and gathers points in them."""

    def __init__(self, setup: Setup) -> None:
        self.setup, self.shape = setup, setup.cells
        self.sum, self.square, self.count = (np.zeros(setup.cells[0] * setup.cells[1]) for _ in range(3))
        self.lowest = np.full(setup.cells[0] * setup.cells[1], np.inf)

    def number(self, points: Array) -> tuple[Array, Array]:
        """Return the flat numbers of the cells that hold points (N, 3), and the points that lie inside."""
        at = np.floor((points[:, :2] - self.setup.low) / self.setup.resolution).astype(np.int64)
        inside = ((at >= 0) & (at < self.shape)).all(1)
        return at[inside, 0] * self.shape[1] + at[inside, 1], points[inside]

    def add(self, points: Array) -> None:
        """Take in points of the map frame."""
        cell, points = self.number(points)
        size, z = len(self.sum), points[:, 2]
        self.sum += np.bincount(cell, z, size)
        self.square += np.bincount(cell, z * z, size)
        self.count += np.bincount(cell, minlength=size)
        np.minimum.at(self.lowest, cell, z)

    def mean(self) -> tuple[Array, Array]:
        """Return mean height and its standard error at each cell, NaN where there is no point."""
        count = np.where(self.count > 0, self.count, np.nan)
        mean = self.sum / count
        variance = np.maximum(self.square / count - mean**2, 0.0) / count
        return mean.reshape(self.shape), np.sqrt(variance).reshape(self.shape)

    def centers(self) -> Array:
        """Return the centres (H, W, 2) [m] of the cells."""
        axes = [self.setup.low[k] + self.setup.resolution * (np.arange(self.shape[k]) + 0.5) for k in (0, 1)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1)


class PointMap:
    """The points of all scans in cells, and their mean: what peers that gather points begin with."""

    def __init__(self, setup: Setup) -> None:
        self.cells = Cells(setup)

    def update(self, frame: Frame) -> None:
        """Add the points."""
        self.cells.add(frame.placed())

    def ground(self) -> tuple[Array, Array | None]:
        """Return the means and their standard errors."""
        return self.cells.mean()
