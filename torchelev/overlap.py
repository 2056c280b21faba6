"""Multi-floor buildings: near the robot only its own floor may stay in the map."""

from __future__ import annotations

from dataclasses import dataclass

from torchelev.errors import require
from torchelev.grid import GridConfig, center_offsets
from torchelev.state import MapState, Measurement, count, tally
from torchelev.storage import realize_all


@dataclass(frozen=True, kw_only=True)
class OverlapConfig:
    """What is near, and what is another floor."""

    radius: float = 3.0  # [m] horizontal distance from the base
    height: float = 1.5  # [m] difference from the base's height

    def __post_init__(self) -> None:
        require(self.radius > 0, "overlap.radius", "must be positive", self.radius, "give metres, or overlap=None")
        require(self.height > 0, "overlap.height", "must be positive", self.height, "give metres, or overlap=None")


def clear_other_floors(state: MapState, m: Measurement, grid: GridConfig, cfg: OverlapConfig) -> MapState:
    """Clear cells near the robot whose height differs from the robot's by more than a threshold (paper, Sec. II-F).

    Skipped without a base pose. The cell's upper bound goes too when it belongs to another floor.
    """
    if m.base is None:
        return state
    x, y = center_offsets(state, m, grid)
    x, y = x - m.base[:, 0, None, None], y - m.base[:, 1, None, None]
    near = x.square() + y.square() <= cfg.radius**2
    height = m.base[:, 2, None, None]
    other = near & state.validity & ((state.elevation - height).abs() > cfg.height)
    other_bound = near & state.bounded & ((state.upper_bound - height).abs() > cfg.height)
    validity, bounded = realize_all(state.validity & ~other, state.bounded & ~(other | other_bound))
    state = state._replace(validity=validity, bounded=bounded)
    return tally(state, cleared_other_floors=count(other))
