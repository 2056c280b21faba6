"""What is near, what is another floor, and how high robots are."""

from __future__ import annotations

from dataclasses import dataclass

from torchelev.errors import require


@dataclass(frozen=True, kw_only=True)
class OverlapConfig:
    """What is near, what is another floor, and how high robots are."""

    radius: float = 3.0  #: [m] horizontal distance from the base
    height: float = 1.5  #: [m] difference from the robot's height
    base_height: float = 0.6  #: [m] the robot's height is its base's, but no higher than this above its ground
    max_base_height: float = 2.5  #: [m] ground farther below the base is not what the robot stands on

    def __post_init__(self) -> None:
        require(self.radius > 0, "overlap.radius", "must be positive", self.radius, "give metres, or overlap=None")
        require(self.height > 0, "overlap.height", "must be positive", self.height, "give metres, or overlap=None")
        low, high = self.base_height, self.max_base_height
        require(low >= 0, "overlap.base_height", "must not be negative", low, "give metres; a legged robot's is 0.5")
        rule, hint = "must be at least overlap.base_height", "give the highest base of your robots [m]"
        require(high >= low, "overlap.max_base_height", rule, high, hint)
