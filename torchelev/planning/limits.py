"""Limits of the robot: step, slope and clearance of the ground, each compared with its own limit.

The limits are those of the map's head: of its robot or, for an analytic head without one, its critical step and slope.
They hold beside the ratings: ground beyond one of them is impassable, however well it is rated.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.ops.windows import padded, shifted, window_maximum
from torchelev.plane_fit import Ground, fit_plane, known_ground
from torchelev.robot import RobotConfig
from torchelev.traversability.heads import LearnedTraversabilityConfig, TraversabilityConfig, find_steps, step_cells

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.config import ElevationMapConfig
    from torchelev.state import MapState

ROUNDING = 1e-3  # [m], [rad] by which ground may exceed a limit


class Limit(IntEnum):
    """What makes ground impassable, whatever its rating; `NONE`: a low rating does, or that the ground is unknown.

    STEP, SLOPE and CLEARANCE are limits of the robot, CLASS is a forbidden class of `TraversalCostConfig.class_costs`,
    CEILING a surface too low above the ground for `TraversalCostConfig.height`.
    """

    NONE = 0
    STEP = 1
    SLOPE = 2
    CLEARANCE = 3
    CLASS = 4
    CEILING = 5


class Limits(NamedTuple):
    """The limits of a robot; infinite where there is none."""

    step: float = math.inf  #: [m] highest step
    slope: float = math.inf  #: [rad] largest inclination
    clearance: float = math.inf  #: [m] highest ground above the ground below the feet

    def describe(self, step: float, slope: float, clearance: float) -> list[str]:
        """Return a sentence for each limit that ground exceeds."""
        step_text = f"a step of {step:.2f} m exceeds the robot's {self.step:.2f} m"
        slope_text = f"a slope of {math.degrees(slope):.0f} degrees exceeds its {math.degrees(self.slope):.0f}"
        clearance_text = (
            f"ground {clearance:.2f} m above that below the feet exceeds its clearance, {self.clearance:.2f} m"
        )
        texts = step_text, slope_text, clearance_text
        asked = step, slope, clearance
        return [text for text, value, limit in zip(texts, asked, self, strict=True) if value > limit + ROUNDING]

    def exceeded(self, step: Tensor, slope: Tensor, clearance: Tensor) -> list[Bool[Tensor, "..."]]:
        """Return where values exceed their limits, in the order of `Limit`."""
        return [value > limit + ROUNDING for value, limit in zip((step, slope, clearance), self, strict=True)]


class Obstacles(NamedTuple):
    """Step, slope and clearance of the ground at each cell, (B, H, W); 0 where they are unknown."""

    step: Float[Tensor, "B H W"]  #: [m]
    slope: Float[Tensor, "B H W"]  #: [rad]
    clearance: Float[Tensor, "B H W"]  #: [m]


def limits_of(cfg: ElevationMapConfig) -> Limits:
    """Return the limits that planning enforces on maps of a config: those of its head's robot, or critical values."""
    head = cfg.traversability
    if head is None:
        return Limits()
    if head.robot is not None:
        return Limits(head.robot.step_height, head.robot.max_slope, head.robot.clearance)
    assert isinstance(head, TraversabilityConfig)
    return Limits(head.critical_step, head.critical_slope)


def first_limit(exceeded: dict[Limit, Bool[Tensor, "..."]]) -> Int[Tensor, "..."]:
    """Return the first `Limit` that is exceeded, int64; NONE where none is."""
    limit = torch.zeros_like(exceeded[Limit.STEP], dtype=torch.int64)
    for which in sorted(exceeded, reverse=True):
        limit = torch.where(exceeded[which], which.value, limit)
    return limit


def find_exceeded(state: MapState, cfg: ElevationMapConfig) -> list[Bool[Tensor, "B H W"]]:
    """Return which cells exceed each of the limits, in the order of `Limit`."""
    return limits_of(cfg).exceeded(*find_obstacles(state, cfg))


def find_obstacles(state: MapState, cfg: ElevationMapConfig) -> Obstacles:
    """Find the step, slope and clearance of every cell, without waiting for the device.

    Step: `compute_steps`. Slope: the inclination of the analytic head's window. For a robot, whose feet choose flat
    ground, the smallest inclination within `foot_reach`, or that below the body if it is smaller: treads of stairs are
    flat, and the ground beside a wall is. Clearance, for a robot: how far the ground rises above that half a body ahead
    and that half a body behind, at the worst of four headings.
    """
    head, resolution = cfg.traversability, cfg.grid.resolution
    dtype = torch.promote_types(state.elevation.dtype, torch.float32)  # half precision cannot hold squares of heights
    elevation, validity = state.elevation.detach().to(dtype), state.validity
    step = compute_steps(elevation, validity, resolution)
    nothing = torch.zeros_like(step)
    if head is None:
        return Obstacles(step, nothing, nothing)
    if head.robot is None:
        assert not isinstance(head, LearnedTraversabilityConfig)
        radius = head.cells(cfg.grid)
        slope = _inclination(known_ground(elevation, validity, radius), radius, resolution)
        return Obstacles(step, torch.where(torch.isinf(slope), 0.0, slope) * validity, nothing)
    slope = _slope_below(head.robot, elevation, validity, resolution)
    return Obstacles(step, slope * validity, _clearance(head.robot, elevation, validity, resolution))


def compute_steps(
    elevation: Float[Tensor, "B H W"], validity: Bool[Tensor, "B H W"], resolution: float
) -> Float[Tensor, "B H W"]:
    """Compute the largest height difference [m] between each known cell and the known cells at most 0.1 m away.

    Cells count at least 1 cell away (`traversability.heads.find_steps`). An unknown cell may be as high or low as those
    around it: between them, it and its neighbours have the step of the highest and the lowest.
    """
    radius = step_cells(resolution)
    ground = known_ground(elevation, validity, radius)
    step = find_steps(ground, radius)
    around = max(1, radius // 2)  # so that pairs across an unknown cell are not farther apart than others
    ends = [padded(torch.where(validity, end, -torch.inf), around, -torch.inf) for end in (elevation, -elevation)]
    highest, minus_lowest = window_maximum(ends, around, around)
    bridged = torch.where(validity, 0.0, highest + minus_lowest).clamp(min=0)
    (bridged,) = window_maximum([padded(bridged, 1, 0.0)], 1, 1)
    return torch.maximum(step * validity, bridged)


def _inclination(ground: Ground, radius: int, resolution: float) -> Float[Tensor, "B H W"]:
    """Return the inclination [rad] of each window's plane, inf where it has none."""
    plane = fit_plane(ground, radius, resolution)
    slope = torch.atan((plane.gradient_x.square() + plane.gradient_y.square()).sqrt())
    return torch.where(plane.spans, slope, torch.inf)


def _slope_below(robot: RobotConfig, elevation: Tensor, validity: Tensor, resolution: float) -> Tensor:
    """Return the slope [rad] that a robot meets at each cell, 0 where no plane is known."""
    body, foot, reach = (
        max(1, round(length / resolution)) for length in (robot.length / 2, robot.foot_reach / 2, robot.foot_reach)
    )
    ground = known_ground(elevation, validity, body)
    feet = torch.where(validity, _inclination(ground, foot, resolution), torch.inf)
    (gentlest,) = window_maximum([padded(-feet, reach, -torch.inf)], reach, reach)
    slope = torch.minimum(-gentlest, _inclination(ground, body, resolution))
    return torch.where(torch.isinf(slope), 0.0, slope)


def _clearance(robot: RobotConfig, elevation: Tensor, validity: Tensor, resolution: float) -> Tensor:
    """Return how far the ground rises [m] above that below both ends of the body, at the worst heading."""
    straight = math.ceil(robot.length / 2 / resolution - 1e-6)
    diagonal = max(1, round(straight / math.sqrt(2)))
    layers = padded(torch.where(validity, elevation, torch.nan), straight, torch.nan)
    highest = torch.zeros_like(elevation)
    for i, j in ((straight, 0), (0, straight), (diagonal, diagonal), (diagonal, -diagonal)):
        ends = torch.maximum(shifted(layers, straight, i, j), shifted(layers, straight, -i, -j))  # NaN if one is
        highest = torch.fmax(highest, elevation - ends)
    return torch.where(validity, highest, 0.0)
