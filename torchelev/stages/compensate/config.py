"""Which points measure the height drift, and how much of it is corrected."""

from __future__ import annotations

from dataclasses import dataclass

from torchelev.errors import require, require_positive
from torchelev.stages.by_tensors import ByTensors


@dataclass(frozen=True, kw_only=True)
class InlierConfig(ByTensors):
    """Points that measure drift as in elevation_mapping_cupy: see `compensate_by_inliers`. Uses tensor operations."""

    gate_per_variance: float = 2.0  #: [1/m] a point counts if |z - h| < gate_per_variance * sigma_m^2

    def __post_init__(self) -> None:
        require_positive(**{"drift.inliers.gate_per_variance": self.gate_per_variance})


@dataclass(frozen=True, kw_only=True)
class DriftConfig:
    """Which points measure the drift, and how much of it is corrected."""

    min_traversability: float | None = None  #: minimum traversability of the cells; None: the default of the head
    max_variance: float = 0.01  #: [m^2] maximum variance of cells that measure the drift
    max_error: float = 0.1  #: [m] maximum height error of a point; points with larger errors are obstacles
    gate: float = 2.0  #: standard deviations around the mean error within which points count
    relief: float = 0.003  #: [m] standard deviation of height within a flat cell
    min_points: int = 50  #: minimum number of points that measure the drift
    max_drift: float = 0.1  #: [m] maximum mean error; a larger error is not corrected
    gain: float = 1.0  #: share of the mean error that is corrected; 1 as in the paper
    inliers: InlierConfig | None = None  #: replaces `max_error`, `gate` and `relief`; None: see `compensate`

    def __post_init__(self) -> None:
        require(0 < self.gain <= 1, "drift.gain", "must lie in (0, 1]", self.gain, "the paper's value is 1")
        gate = self.min_traversability
        share = gate is None or (isinstance(gate, int | float) and 0 <= gate <= 1)
        hint = "leave it out for the head's own"
        require(share, "drift.min_traversability", "must lie in [0, 1] or be None", repr(gate), hint)
        require(self.min_points >= 1, "drift.min_points", "must be at least 1", self.min_points, "give 50")
