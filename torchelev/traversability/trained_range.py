"""The maps and robots that a learned head is trained for, and a robot's proportions as the head is given them."""

from __future__ import annotations

import math
from collections.abc import Mapping

from torchelev.errors import require
from torchelev.robot import RobotConfig

RESOLUTIONS = (0.02, 0.1)  # [m] limits of the maps
_TOLERANCE = 1e-6  # relative, of limits


def ratios(robot: RobotConfig, resolution: float) -> dict[str, float]:
    """Return a robot's proportions, which its windows and dimensionless heights do not contain."""
    return {
        "robot.width / length": robot.width / robot.length,
        "robot.clearance / step_height": robot.clearance / robot.step_height,
        "robot.foot_radius / length": robot.foot_radius / robot.length,
        "robot.foot_reach / length": robot.foot_reach / robot.length,
        "tan(robot.max_slope) * length / step_height": math.tan(robot.max_slope) * robot.length / robot.step_height,
        "resolution / robot.length": resolution / robot.length,
        "robot.step_height": robot.step_height,  # [m] as sensor noise and drift do not scale with the robot
    }


# Limits of the ratios of the robots that a head is trained for by default.
RANGES = {
    "robot.width / length": (0.4, 0.8),
    "robot.clearance / step_height": (0.85, 3.4),
    "robot.foot_radius / length": (0.03, 0.06),
    "robot.foot_reach / length": (0.1, 0.2),
    "tan(robot.max_slope) * length / step_height": (0.88, 5.7),
    "resolution / robot.length": (0.02, 0.25),
    "robot.step_height": (0.06, 0.35),
}


def conditions(robot: RobotConfig, resolution: float) -> list[float]:
    """Return the logarithms of the ratios, scaled to -1 and 1 at the limits in RANGES."""
    logs = ((math.log(ratio), *map(math.log, RANGES[name])) for name, ratio in ratios(robot, resolution).items())
    return [(2 * value - low - high) / (high - low) for value, low, high in logs]


def require_in_ranges(ranges: Mapping[str, tuple[float, float]], robot: RobotConfig, resolution: float) -> None:
    """Refuse a resolution outside RESOLUTIONS, and a robot whose ratios are outside the ranges."""
    low, high = RESOLUTIONS
    rule, hint = f"must be {low:g} to {high:g} m", "resample the map"
    require(_is_within(resolution, RESOLUTIONS), "resolution", rule, resolution, hint)
    hint = "train a head for this robot: python -m training.traversability --robot ..."
    for name, ratio in ratios(robot, resolution).items():
        low, high = ranges[name]
        fits = _is_within(ratio, ranges[name])
        require(fits, name, f"must be within {low:.3g} to {high:.3g}, as trained", f"{ratio:.4g}", hint)


def _is_within(value: float, limits: tuple[float, float]) -> bool:
    """Return whether a value lies within limits, up to rounding."""
    low, high = limits
    return low * (1 - _TOLERANCE) <= value <= high * (1 + _TOLERANCE)
