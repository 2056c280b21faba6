"""The robot that stands on the map: its sizes, as far as the ground must carry it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from torchelev.errors import require, require_positive


@dataclass(frozen=True, kw_only=True)
class RobotConfig:
    """A legged robot that stands on four feet at the corners of a rectangle."""

    length: float = 0.7  #: [m] between front and hind feet
    width: float = 0.4  #: [m] between left and right feet
    foot_radius: float = 0.03  #: [m]
    foot_reach: float = 0.1  #: [m] by which a foot may choose another place than its nominal one
    step_height: float = 0.2  #: [m] that a foot can overcome
    clearance: float = 0.3  #: [m] that the legs leave between ground and belly
    max_slope: float = 0.5  #: [rad] of the body

    def __post_init__(self) -> None:
        require_positive(**{field.name: getattr(self, field.name) for field in fields(self)})
        steep = self.max_slope < math.pi / 2
        require(steep, "robot.max_slope", "must be below a right angle", self.max_slope, "give radians, such as 0.5")
        wide = self.width <= self.length
        require(wide, "robot.width", "must not exceed the length", (self.width, self.length), "swap them")
