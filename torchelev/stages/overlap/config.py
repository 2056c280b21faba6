"""Overlap-clearance thresholds."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchelev.errors import require
from torchelev.stages.by_tensors import ByTensors


@dataclass(frozen=True, kw_only=True)
class SquareConfig(ByTensors):
    """A square that is cleared, as elevation_mapping_cupy does: see `clear_square`. Tensors update maps with it."""

    side: float = 4.0  #: [m] of the square in the window's middle
    height: float = 2.0  #: [m] heights farther from the first sensor's, below or above, are cleared

    def __post_init__(self) -> None:
        for name in ("side", "height"):
            value = getattr(self, name)
            require(0 < value < math.inf, f"overlap.square.{name}", "must be positive and finite", value, "give metres")


@dataclass(frozen=True, kw_only=True)
class OverlapConfig:
    """What is near, what is another floor, and how high robots are."""

    radius: float = 3.0  #: [m] horizontal distance from the base
    height: float = 1.5  #: [m] difference from the robot's height
    base_height: float = 0.6  #: [m] the robot's height is its base's, but no higher than this above its ground
    max_base_height: float = 2.5  #: [m] ground farther below the base is not what the robot stands on
    square: SquareConfig | None = None  #: in place of all of the above; None: see `clear_other_floors`

    def __post_init__(self) -> None:
        require(self.radius > 0, "overlap.radius", "must be positive", self.radius, "give metres, or overlap=None")
        require(self.height > 0, "overlap.height", "must be positive", self.height, "give metres, or overlap=None")
        low, high = self.base_height, self.max_base_height
        require(low >= 0, "overlap.base_height", "must not be negative", low, "give metres; a legged robot's is 0.5")
        rule, hint = "must be at least overlap.base_height", "give the highest base of your robots [m]"
        require(high >= low, "overlap.max_base_height", rule, high, hint)
