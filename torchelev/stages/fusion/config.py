"""Settings of the height update."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from torchelev.errors import require, require_count
from torchelev.stages.by_tensors import ByTensors

MAX_REFINEMENTS = 100  # after some thirty, float32 has no digits left


@dataclass(frozen=True, kw_only=True)
class EdgeConfig:
    """When a cell counts as a step: many points, whose heights differ by more than their noise explains."""

    min_points: int = 6  #: minimum number of points in a cell with a step
    #: minimum mean misfit of the cell's points: their squared distance from its height in units of the gate, at most 1
    min_share: float = 0.25
    min_passed: float = 0.1  #: share of the low points that must pass the centre for the ground to win over the top
    min_extreme: int = 2  #: minimum number of points within a standard deviation of the top or bottom
    refinements: int = 7  #: iterations; each halves the distance to the top of a wall
    margin: float = 0.25  #: standard deviations below the top within which points belong to the top
    min_settled: float = 6.0  #: minimum support [points] for a wall's top to persist although a scan sees less of it

    def __post_init__(self) -> None:
        for name, least in dict(min_points=2, min_extreme=1, refinements=2).items():
            require_count(f"fusion.edges.{name}", getattr(self, name), "see its default", least)
        many, hint = self.refinements > MAX_REFINEMENTS, "see its default"
        rule = f"must be at most {MAX_REFINEMENTS}"
        require(not many, "fusion.edges.refinements", rule, self.refinements, hint)
        require(self.margin >= 0, "fusion.edges.margin", "must not be negative", self.margin, "give 0.25")
        require(self.min_share > 0, "fusion.edges.min_share", "must be positive", self.min_share, "give 0.25")

    def has_step(self, number: Tensor, misfit: Tensor) -> Tensor:
        """Return which cells hold a step, by the number of their points and the sum of their misfits."""
        return (number >= self.min_points) & (misfit >= self.min_share * number)


@dataclass(frozen=True, kw_only=True)
class AveragingConfig(ByTensors):
    """Averaged fusion as elevation_mapping_cupy computes it: see `average`. Uses tensor operations."""

    gate_per_variance: float = 2.0  #: [1/m] a point is an outlier if |z - h| > gate_per_variance * sigma_m^2
    variance_per_outlier: float = 0.01  #: [m^2] added to a cell's variance for each outlier
    unknown_variance: float = 1000.0  #: [m^2] variance of an unknown cell before its first points
    wall_points: int | None = 20  #: cells with more points ignore those below their elevation; None: average all

    def __post_init__(self) -> None:
        for name in ("gate_per_variance", "unknown_variance"):
            value, hint = getattr(self, name), "see its default"
            require(0 < value < math.inf, f"fusion.averaging.{name}", "must be positive and finite", value, hint)
        added, hint = self.variance_per_outlier, "give 0.01"
        require(0 <= added < math.inf, "fusion.averaging.variance_per_outlier", "must not be negative", added, hint)
        if self.wall_points is not None:
            require_count("fusion.averaging.wall_points", self.wall_points, "give 20, or None")


@dataclass(frozen=True, kw_only=True)
class FusionConfig:
    """Kalman update and outlier gate."""

    gate: float = 3.0  #: Mahalanobis distance beyond which a point is an outlier
    max_gate_std: float = 0.05  #: [m] upper limit of a cell's standard deviation in the gate
    relief: float = 0.25  #: [cells] standard deviation of the height within a cell of rough or sloped ground
    scan_variance_floor: float = 1e-6  #: [m^2] minimum variance of a scan; its points share the error of the pose
    outlier_variance: float = 1e-4  #: [m^2] added to a cell's variance by a scan that mostly disagrees
    max_support: float = 60.0  #: upper limit of support: so many points must disagree to replace a settled cell
    min_above: int = 5  #: points above a cell that replace its height, regardless of its support: `challenge.py`
    max_above_per_scan: int = 2  #: upper limit of these points per scan, so that a single bad scan adds no obstacle
    max_variance: float = 1.0  #: [m^2] upper limit of a cell's variance
    edges: EdgeConfig | None = EdgeConfig()  #: walls and steps within a cell; None: every cell averages its points
    averaging: AveragingConfig | None = None  #: replaces all of the above except `max_variance`; None: see `fuse`

    def __post_init__(self) -> None:
        fits, hint = self.edges is None or isinstance(self.edges, EdgeConfig), "None keeps no edges sharp"
        require(fits, "fusion.edges", "must be an EdgeConfig or None", repr(self.edges), hint, TypeError)
        for name in ("gate", "max_gate_std", "scan_variance_floor", "max_variance"):
            require(
                getattr(self, name) > 0, f"fusion.{name}", "must be positive", getattr(self, name), "see its default"
            )
        for name in ("relief", "max_support"):
            good, hint = 0 <= getattr(self, name) < math.inf, "see its default"
            require(good, f"fusion.{name}", "must be finite and not negative", getattr(self, name), hint)
        for name in ("min_above", "max_above_per_scan"):
            number = require_count(f"fusion.{name}", getattr(self, name), "see its default")
            require(number <= 255, f"fusion.{name}", "must be at most 255 points", number, "see its default")
        for name in ("scan_variance_floor", "max_variance"):
            finite, hint = math.isfinite(getattr(self, name)), "give a large number such as 1e6"
            require(finite, f"fusion.{name}", "must be finite", getattr(self, name), hint)
