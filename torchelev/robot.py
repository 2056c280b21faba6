"""The robot that the ground is rated for."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from torchelev.errors import require, require_positive


@dataclass(frozen=True, kw_only=True)
class RobotConfig:
    """Sizes and abilities of a legged robot that stands on four feet, at the corners of a rectangle."""

    length: float = 0.7  #: [m] distance from front to hind feet
    width: float = 0.4  #: [m] distance from left to right feet
    foot_radius: float = 0.03  #: [m] radius of a foot's contact area
    foot_reach: float = 0.1  #: [m] maximum distance of a foothold from the foot's nominal position
    step_height: float = 0.2  #: [m] maximum step height that a foot can overcome
    clearance: float = 0.3  #: [m] height of the belly above the feet
    max_slope: float = 0.5  #: [rad] maximum inclination of the body

    def __post_init__(self) -> None:
        require_positive(**{field.name: getattr(self, field.name) for field in fields(self)})
        is_slope = self.max_slope < math.pi / 2
        require(is_slope, "robot.max_slope", "must be below a right angle", self.max_slope, "give radians, such as 0.5")
        is_long = self.width <= self.length
        require(is_long, "robot.width", "must not exceed the length", (self.width, self.length), "swap them")
