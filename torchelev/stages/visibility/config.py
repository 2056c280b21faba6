"""When a ray removes a cell, and which rays are accepted."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchelev.errors import require
from torchelev.grid import GridConfig
from torchelev.stages.by_tensors import ByTensors
from torchelev.stages.visibility.polar_table import PolarGrid

MAX_CELLS = 2**14  # that rays count up to: C++ counts the places of the polar table in 32 bits


@dataclass(frozen=True, kw_only=True)
class SteppingConfig(ByTensors):
    """Ray marching as in elevation_mapping_cupy: see `clear_by_steps`. Uses tensor operations."""

    validity_per_ray: float = 0.1  #: decrease of a cell's validity by a ray of `max_range`; more for shorter rays
    variance_per_ray: float = 0.01  #: [m^2] added to a cell's variance by each ray that passes below it

    def __post_init__(self) -> None:
        for name in ("validity_per_ray", "variance_per_ray"):
            value, argument = getattr(self, name), f"raycast.steps.{name}"
            require(0 <= value < math.inf, argument, "must be finite and not negative", value, "see its default")


@dataclass(frozen=True, kw_only=True)
class RaycastConfig:
    """When a ray removes a cell, and which rays are accepted."""

    min_time: float = 1.0  #: [s] cells hit within this time stay, and contradict rays that pass below them
    min_incidence: float = 0.1  #: alpha_n: rays with |r . n| below it are grazing and remove nothing
    max_range: float | None = None  #: [m] length up to which rays are used; None: 1.1 half-diagonals of the window
    min_support: float = 3.0  #: minimum support of a cell, or of a neighbour, to accept rays that end in it
    gate: float = 3.0  #: rays more standard deviations below known ground are wrong returns
    steps: SteppingConfig | None = None  #: step along each ray, see `SteppingConfig`; None: the lowest ray decides

    def __post_init__(self) -> None:
        require(self.min_time >= 0, "raycast.min_time", "must not be negative", self.min_time, "give seconds")
        cosine = 0 <= self.min_incidence < 1
        require(cosine, "raycast.min_incidence", "must lie in [0, 1)", self.min_incidence, "give a cosine such as 0.1")
        reach = self.max_range is None or 0 < self.max_range < math.inf
        require(self.gate > 0, "raycast.gate", "must be positive", self.gate, "give standard deviations, such as 3")
        require(reach, "raycast.max_range", "must be positive and finite", self.max_range, "give metres, or None")
        support = 0 <= self.min_support < math.inf
        require(support, "raycast.min_support", "must be finite and not negative", self.min_support, "give points")

    def reach(self, grid: GridConfig) -> float:
        """Return how far [m] rays count."""
        return self.max_range or 0.55 * math.hypot(grid.length_x, grid.length_y)

    def require_grid(self, grid: GridConfig) -> None:
        """Refuse rays that reach over more cells than the polar table can have."""
        reach = PolarGrid.of(grid, self).ranges
        rule = f"rays of {grid.resolution:g} m cells must reach over at most {MAX_CELLS:,} of them"
        hint = "use larger cells, or a shorter window" if self.max_range is None else "give fewer metres, or None"
        require(reach <= MAX_CELLS, "raycast.max_range", rule, f"{reach:,} cells", hint)
