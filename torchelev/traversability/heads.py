"""Traversability: a head that looks at the map and says where a robot can stand.

Two heads share one place in the map: an analytic one, and one that was trained (paper, Sec. II-G).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.grid import GridConfig
from torchelev.ops.masks import NOWHERE
from torchelev.ops.windows import window_maximum
from torchelev.robot import RobotConfig
from torchelev.stages.surface import Ground, fit_plane
from torchelev.state import MapState
from torchelev.traversability.net import Rating, TraversabilityNet
from torchelev.traversability.rate import rate
from torchelev.traversability.weight_file import Weights

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["LearnedTraversabilityConfig", "Rating", "RobotConfig", "TraversabilityConfig", "TraversabilityNet"]


@dataclass(frozen=True, kw_only=True)
class TraversabilityConfig:
    """Critical values of the analytic head: at each of them traversability is zero."""

    radius: float = 0.1  #: [m] of the window that a foot or wheel needs
    critical_slope: float = 0.7  #: [rad] inclination of the window's plane
    critical_step: float = 0.2  #: [m] height of a step within the window
    critical_roughness: float = 0.05  #: [m] standard deviation around the local plane

    # From which rating on cells measure the height drift; measured by `training.traversability.drift_gate`.
    drift_gate: ClassVar[float] = 0.5

    def __post_init__(self) -> None:
        for name in ("radius", "critical_slope", "critical_step", "critical_roughness"):
            value = getattr(self, name)
            require(value > 0, f"traversability.{name}", "must be positive", value, "see its default")

    def cells(self, grid: GridConfig) -> int:
        """Return the window's radius in cells."""
        return max(1, round(self.radius / grid.resolution))

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

    #: size and abilities of the robot that the ground is rated for
    robot: RobotConfig = field(default_factory=RobotConfig)
    weights: str | Path | None = None  #: file that `TraversabilityNet.save` wrote; None: the shipped weights

    drift_gate: ClassVar[float] = 0.2  # as of the analytic head

    def __post_init__(self) -> None:
        hint = "build a RobotConfig"
        fits = isinstance(self.robot, RobotConfig)
        require(fits, "traversability.robot", "must be a RobotConfig", repr(self.robot), hint, TypeError)
        path = self.weights is None or isinstance(self.weights, str | Path)
        require(path, "traversability.weights", "must be a path or None", repr(self.weights), "give a str", TypeError)
        if isinstance(self.weights, Path):
            object.__setattr__(self, "weights", str(self.weights))  # as files of settings hold it


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
    net = TraversabilityNet.from_pretrained(cfg.weights).requires_grad_(False) if given is None else given
    net.require_trained(cfg.robot, grid.resolution)
    return net


def learned_rating(state: MapState, grid: GridConfig, cfg: LearnedTraversabilityConfig, weights: Weights) -> Rating:
    """Rate every cell, unknown ones too, by the trained head."""
    layers = (state.elevation, state.validity, state.variance, state.upper_bound, state.bounded)
    logits = rate(weights, *layers, resolution=grid.resolution, robot=cfg.robot)
    return Rating(*(torch.sigmoid(logit).to(state.elevation.dtype) for logit in logits))


def height_range(ground: Ground, radius: int) -> Tensor:
    """Return how much higher the highest known cell of each window is than the lowest [m]; negative without any."""
    sunk = NOWHERE * (ground.known - 1)  # where nothing is known
    highest, minus_lowest = window_maximum([sunk + ground.height, sunk - ground.height], ground.rim, radius)
    return highest + minus_lowest


def rate_all(state: MapState) -> MapState:
    """Rate no cell: without a head, all known cells count in drift compensation."""
    return state._replace(traversability=torch.ones_like(state.traversability), rated=torch.zeros_like(state.rated))


class PlaneRating(NamedTuple):
    """What the analytic head tells."""

    traversability: Float[Tensor, "B H W"]  #: in [0, 1]
    rated: Bool[Tensor, "B H W"]  #: known cells whose window spans a plane; elsewhere traversability is 0


def traversability(
    ground: Ground, validity: Bool[Tensor, "B H W"], radius: int, resolution: float, critical: Critical
) -> PlaneRating:
    """Rate every known cell whose window spans a plane, by the worst of slope, step and roughness.

    t = 1 - max(slope / critical, step / critical, roughness / critical), not below 0. The step is the height range of
    the window less what its own plane explains.
    """
    plane = fit_plane(ground, radius, resolution)
    slope = torch.atan((plane.gradient_x.square() + plane.gradient_y.square()).clamp(min=1e-12).sqrt())
    explained = 2 * radius * resolution * (plane.gradient_x.abs() + plane.gradient_y.abs())
    step = (height_range(ground, radius) - explained).clamp(min=0)
    roughness = plane.residual.clamp(min=1e-12).sqrt()
    worst = torch.maximum(slope / critical.slope, step / critical.step)
    worst = torch.maximum(worst, roughness / critical.roughness)
    rated = validity & plane.spans
    return PlaneRating((1 - worst).clamp(min=0) * rated, rated)
