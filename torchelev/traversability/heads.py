"""Traversability heads, which rate where a robot can stand.

Two heads share one place in the map: an analytic one, and one that was trained (paper, Sec. II-G).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.grid import GridConfig
from torchelev.ops.masks import NOWHERE
from torchelev.ops.windows import shifted, window_maximum
from torchelev.plane_fit import MAX_RADIUS, Ground, fit_plane
from torchelev.robot import RobotConfig
from torchelev.state import MapState
from torchelev.traversability.rating import Rating

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from torchelev.traversability.net import TraversabilityNet
    from torchelev.traversability.weight_file import Weights

__all__ = ["LearnedTraversabilityConfig", "Rating", "RobotConfig", "TraversabilityConfig", "TraversabilityNet"]


def __getattr__(name: str) -> Any:
    """Import the network when it is asked for: the analytic head needs none."""
    if name != "TraversabilityNet":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name)
    from torchelev.traversability.net import TraversabilityNet

    return TraversabilityNet


STEP_REACH = 0.1  # [m] within which a height difference is a step: a foot's length and the smear of an edge
EDGE_SLOPE, EDGE_ROUGHNESS = 0.75, 12**-0.5  # at most, of a plane near a step h: in h / radius, and in h
RATING_AT_LIMIT = 0.31  # of ground at the limits of `of_robot`: just above the threshold of `plan` and `check_path`


@dataclass(frozen=True, kw_only=True)
class TraversabilityConfig:
    """Critical values of the analytic head: at each of them traversability is zero. Infinity switches one off.

    `plan` and `check_path` enforce the limits of `robot` or, without one, the critical step and slope.

    Raises:
        ValueError: for a critical value that is not positive, or a slope of a right angle or more.
        TypeError: for a robot that is not a RobotConfig.
    """

    radius: float = 0.1  #: [m] radius of the window that a foot or wheel needs
    critical_slope: float = 0.7  #: [rad] maximum slope of the window's plane, below pi / 2; inf: slopes are ignored
    #: [m] maximum step between a cell and the cells of its window, at most 0.1 m away; inf: steps are ignored
    critical_step: float = 0.2
    critical_roughness: float = 0.05  #: [m] maximum standard deviation around the plane; inf: roughness is ignored
    robot: RobotConfig | None = None  #: robot whose limits planning enforces, see `of_robot`; None: no robot

    # From which rating on cells measure the height drift; measured by `training.traversability.drift_gate`.
    drift_gate: ClassVar[float] = 0.5

    def __post_init__(self) -> None:
        is_length = 0 < self.radius < math.inf
        require(is_length, "traversability.radius", "must be positive and finite", self.radius, "give 0.1")
        off = "give inf to switch it off"
        for name in ("critical_slope", "critical_step", "critical_roughness"):
            value = getattr(self, name)
            require(value > 0, f"traversability.{name}", "must be positive", value, off)
        is_slope, rule = self.critical_slope < math.pi / 2 or math.isinf(self.critical_slope), "must be below pi / 2"
        hint = f"give radians, such as 0.7, or {off[5:]}"
        require(is_slope, "traversability.critical_slope", rule, self.critical_slope, hint)
        if self.robot is not None:
            _require_robot(self.robot)

    @classmethod
    def of_robot(cls, robot: RobotConfig) -> TraversabilityConfig:
        """Return the critical values for a robot: its largest step and slope.

        Near the edge of a step h, a foot's window of radius r has a plane of a slope up to atan(3 h / (4 r)) and a
        roughness up to h / sqrt(12). All that belongs to the highest step that the robot overcomes is rated 0.31 or
        more, just above the thresholds of `plan` and `check_path`, which enforce the robot's own limits besides.

        Args:
            robot: its `foot_reach`, `step_height` and `max_slope` make the critical values.
        """
        share, step, radius = 1 - RATING_AT_LIMIT, robot.step_height, robot.foot_reach
        slope = max(robot.max_slope, math.atan(EDGE_SLOPE * step / radius)) / share
        return cls(
            radius=radius,
            critical_slope=slope if slope < math.pi / 2 else math.inf,
            critical_step=step / share,
            critical_roughness=EDGE_ROUGHNESS * step / share,
            robot=robot,
        )

    def cells(self, grid: GridConfig) -> int:
        """Return the window's radius in cells."""
        return max(1, round(self.radius / grid.resolution))

    def require_grid(self, grid: GridConfig) -> None:
        """Refuse a window of more cells than `surface.radius` may have."""
        cells = self.radius / grid.resolution
        rule = f"must be at most {MAX_RADIUS} cells of {grid.resolution:g} m"
        require(cells <= MAX_RADIUS, "traversability.radius", rule, self.radius, "give 0.1")

    @property
    def critical(self) -> Critical:
        """The critical values."""
        return Critical(self.critical_slope, self.critical_step, self.critical_roughness)


class Critical(NamedTuple):
    """Critical values of the analytic head."""

    slope: float  #: [rad]
    step: float  #: [m]
    roughness: float  #: [m]


@dataclass(frozen=True, kw_only=True)
class LearnedTraversabilityConfig:
    """The trained head: the robot that it rates the ground for, and a file of weights if not those of torchelev."""

    #: size and abilities of the robot
    robot: RobotConfig = field(default_factory=RobotConfig)
    weights: str | Path | None = None  #: file written by `TraversabilityNet.save`; None: the shipped weights

    drift_gate: ClassVar[float] = 0.2  # as of the analytic head

    def __post_init__(self) -> None:
        _require_robot(self.robot)
        path = self.weights is None or isinstance(self.weights, str | Path)
        require(path, "traversability.weights", "must be a path or None", repr(self.weights), "give a str", TypeError)
        if isinstance(self.weights, Path):
            object.__setattr__(self, "weights", str(self.weights))  # as files of settings hold it


def _require_robot(robot: object) -> None:
    fits = isinstance(robot, RobotConfig)
    require(fits, "traversability.robot", "must be a RobotConfig", repr(robot), "build a RobotConfig", TypeError)


def make_head(
    cfg: TraversabilityConfig | LearnedTraversabilityConfig | None, grid: GridConfig, given: TraversabilityNet | None
) -> TraversabilityNet | None:
    """Return the trained head that a config asks for: the given one, or one of its file, frozen; else None.

    Raises ValueError if it does not suit the robot or the resolution, or if the config asks for none.
    """
    if not isinstance(cfg, LearnedTraversabilityConfig):
        hint = "give the config a LearnedTraversabilityConfig"
        require(given is None, "head", "must be None unless the config asks for a trained one", "a head", hint)
        return None
    from torchelev.traversability.net import TraversabilityNet  # see `__getattr__`

    net = TraversabilityNet.from_pretrained(cfg.weights).requires_grad_(False) if given is None else given
    net.require_trained(cfg.robot, grid.resolution)
    return net


def learned_rating(state: MapState, grid: GridConfig, cfg: LearnedTraversabilityConfig, weights: Weights) -> Rating:
    """Rate every cell, unknown ones too, by the trained head."""
    from torchelev.traversability.rate import rate  # as above

    layers = (state.elevation, state.validity, state.variance, state.upper_bound, state.bounded)
    logits = rate(weights, *layers, resolution=grid.resolution, robot=cfg.robot)
    return Rating(*(torch.sigmoid(logit).to(state.elevation.dtype) for logit in logits))


def step_cells(resolution: float) -> int:
    """Return within how many cells a height difference is a step: `STEP_REACH`, or the neighbouring cells."""
    return max(1, round(STEP_REACH / resolution))


def find_steps(ground: Ground, radius: int) -> Float[Tensor, "B H W"]:
    """Return the largest height difference [m] between each known cell and the known ones within `radius` cells of it.

    s(c) = max over the known cells k of the window of |h_k - h_c|; arbitrary for unknown cells c.
    """
    sunk = NOWHERE * (ground.known - 1)  # where nothing is known
    highest, minus_lowest = window_maximum([sunk + ground.height, sunk - ground.height], ground.rim, radius)
    height = shifted(ground.height, ground.rim)
    return torch.maximum(highest - height, minus_lowest + height)


class PlaneRating(NamedTuple):
    """The layers of the analytic head."""

    traversability: Float[Tensor, "B H W"]  #: in [0, 1]
    rated: Bool[Tensor, "B H W"]  #: known cells whose window spans a plane; elsewhere traversability is 0


def traversability(
    ground: Ground, validity: Bool[Tensor, "B H W"], radius: int, resolution: float, critical: Critical
) -> PlaneRating:
    """Rate every known cell whose window spans a plane, by the worst of slope, step and roughness.

    t = 1 - max(slope / critical, step / critical, roughness / critical), not below 0. Slope and roughness are those of
    the window's plane. The step is the largest height difference between the cell and the known cells at most
    `STEP_REACH` away (`find_steps`), whatever the plane: a smooth slope a has a step of STEP_REACH tan a on any grid
    of cells that are not larger.
    """
    plane = fit_plane(ground, radius, resolution)
    slope = torch.atan((plane.gradient_x.square() + plane.gradient_y.square()).clamp(min=1e-12).sqrt())
    step = find_steps(ground, min(radius, step_cells(resolution)))
    roughness = plane.residual.clamp(min=1e-12).sqrt()
    worst = torch.maximum(slope / critical.slope, step / critical.step)
    worst = torch.maximum(worst, roughness / critical.roughness)
    rated = validity & plane.spans
    return PlaneRating((1 - worst).clamp(min=0) * rated, rated)
