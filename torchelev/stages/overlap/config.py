"""Overlap-clearance thresholds."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchelev.errors import require
from torchelev.stages.by_tensors import ByTensors


@dataclass(frozen=True, kw_only=True)
class SquareConfig(ByTensors):
    """Square that is cleared, as in elevation_mapping_cupy: see `clear_square`. Uses tensor operations."""

    side: float = 4.0  #: [m] side length of the square in the window's centre
    height: float = 2.0  #: [m] maximum height difference from the first sensor; other cells are cleared

    def __post_init__(self) -> None:
        for name in ("side", "height"):
            value = getattr(self, name)
            require(0 < value < math.inf, f"overlap.square.{name}", "must be positive and finite", value, "give metres")


@dataclass(frozen=True, kw_only=True)
class OverlapConfig:
    """Which cells near the robot count as another floor."""

    radius: float = 3.0  #: [m] horizontal distance from the base within which cells are cleared
    height: float = 1.5  #: [m] maximum height difference from the robot; other cells are cleared
    base_height: float = 0.6  #: [m] upper limit of the robot's height above its ground
    max_base_height: float = 2.5  #: [m] maximum height of the base above the ground that it stands on
    square: SquareConfig | None = None  #: replaces all of the above; None: see `clear_other_floors`

    def __post_init__(self) -> None:
        require(self.radius > 0, "overlap.radius", "must be positive", self.radius, "give metres, or overlap=None")
        require(self.height > 0, "overlap.height", "must be positive", self.height, "give metres, or overlap=None")
        low, high = self.base_height, self.max_base_height
        require(low >= 0, "overlap.base_height", "must not be negative", low, "give metres; a legged robot's is 0.5")
        rule, hint = "must be at least overlap.base_height", "give the highest base of your robots [m]"
        require(high >= low, "overlap.max_base_height", rule, high, hint)
