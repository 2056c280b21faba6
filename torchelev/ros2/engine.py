"""What a node asks of a map, whichever keeps it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


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


class Engine(Protocol):
    """What a node asks of a map."""

    def update(self, points: NDArray, T_map_sensor: NDArray, T_map_base: NDArray, dt: float) -> None:
        """Fuse points (N, 3) of one sensor."""

    def window(self) -> Window:
        """Return where the cells lie."""

    def layer(self, name: str) -> NDArray[np.float32]:
        """Return a layer (H, W), NaN where unknown; ValueError if there is none of this name."""

    def scan(self, T_map_base: NDArray) -> NDArray[np.float32]:
        """Return the values (P,) of the height scan."""

    def statistics(self) -> dict[str, float]:
        """Return what the last update did."""

    def diagnose(self) -> list[str]:
        """Return what looks wrong with the inputs."""

    def reset(self) -> None:
        """Forget everything."""

    def save(self, path: Path) -> None:
        """Save the map; ValueError or OSError if this fails."""

    def load(self, path: Path) -> None:
        """Load a map that was saved; ValueError or OSError if this fails, and the map is as it was."""


def thinned(points: NDArray, most: int) -> NDArray:
    """Return every k-th point, so that there are at most so many."""
    return points[:: max(1, math.ceil(len(points) / most))]
