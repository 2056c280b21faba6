"""What a node asks of a map, whichever keeps it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from torchelev.levels.config import LevelsConfig


class Window(NamedTuple):
    """Where a map's cells lie."""

    corner: tuple[float, float]  #: [m] the smallest x and y
    resolution: float  #: [m]
    shape: tuple[int, int]  #: H, W

    @property
    def center(self) -> tuple[float, float]:
        """Centre of the window [m]."""
        return (
            self.corner[0] + 0.5 * self.shape[0] * self.resolution,
            self.corner[1] + 0.5 * self.shape[1] * self.resolution,
        )


class SensorInput(NamedTuple):
    """The points of one sensor at one instant."""

    points: NDArray[np.float32]  #: (N, 3) [m] sensor frame
    T_map_sensor: NDArray[np.float64]  #: (4, 4)
    T_map_base: NDArray[np.float64]  #: (4, 4)
    dt: float  #: [s] since the last one
    pose_covariance: NDArray[np.float64] | None = None  #: (6, 6) of the sensor's pose; None: it is exact
    T_base_links: NDArray[np.float64] | None = None  #: (K, 4, 4) in the order of `Engine.links`; None without links


class PathAnswer(NamedTuple):
    """Where a footprint may stand along a path."""

    is_safe: bool  #: all along
    unsafe: list[int]  #: numbers of the poses that cannot be reached safely
    reason: str  #: a sentence


class Engine(Protocol):
    """What a node asks of a map."""

    links: list[str]  #: names of the links of the robot's body, whose poses updates take
    levels: LevelsConfig | None  #: of a map that knows ceilings

    def update(self, given: SensorInput) -> None:
        """Fuse the points of one sensor."""

    def window(self) -> Window:
        """Return where the cells lie."""

    def layer(self, name: str) -> NDArray[np.float32]:
        """Return a layer (H, W), NaN where unknown; ValueError if there is none of this name."""

    def scan(self, T_map_base: NDArray) -> NDArray[np.float32]:
        """Return the values (P,) of the height scan."""

    def statistics(self) -> dict[str, float]:
        """Return what the last update did."""

    def diagnose(self) -> list[str]:
        """Return what looks wrong with the inputs, or looked so some seconds ago."""

    def planes(self) -> list[Any]:
        """Return the planar regions; ValueError if this engine finds none."""

    def check_path(
        self, poses: NDArray[np.float64], footprint: NDArray[np.float64], T_map_base: NDArray[np.float64] | None
    ) -> PathAnswer:
        """Move a footprint (V, 2) [m] along poses (T, 3), x, y [m] and yaw [rad]; ValueError if it cannot.

        Unknown cells count as passable where the robot stands, at T_map_base; None: nowhere.
        """

    def reset(self) -> None:
        """Forget everything."""

    def clear_around(self, center: NDArray[np.float64], radius: float) -> None:
        """Forget the cells within a radius [m] of a place (2,) [m]."""

    def initialize(self, feet: NDArray[np.float64], method: str, T_map_base: NDArray[np.float64]) -> None:
        """Estimate the unknown cells around the robot from ground points (K, 3) [m]."""

    def initialize_from(self, site: Path, T_map_base: NDArray[np.float64]) -> None:
        """Start with what a site map knows; ValueError if this engine cannot."""

    def save(self, path: Path) -> None:
        """Save the map; ValueError or OSError if this fails."""

    def load(self, path: Path) -> None:
        """Load a map that was saved; ValueError or OSError if this fails, and the map is as it was."""


def thinned(points: NDArray, max_points: int) -> NDArray:
    """Return every k-th point, so that there are at most so many."""
    return points[:: max(1, math.ceil(len(points) / max_points))]
