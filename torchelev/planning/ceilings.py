"""Where the robot does not fit below what hangs above the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.errors import require
from torchelev.planning.limits import ROUNDING
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool


def too_low(emap: ElevationMap, height: float | None, state: MapState | None = None) -> Bool[Tensor, "B H W"] | None:
    """Return the cells whose known clearance is less than the robot's height; None of a map without levels.

    Args:
        emap: the maps.
        height: of the robot [m]; None: `min_gap` of the levels.
        state: the state to read; None: that of the maps.

    Raises:
        ValueError: if a height is given for a map without levels.
    """
    if emap.levels is None:
        hint = "give the map levels=LevelsConfig(), or leave it out"
        require(height is None, "height", "needs a map with levels, which knows ceilings", height, hint)
        return None
    assert emap.cfg.levels is not None
    clearance, known = emap.read_layer("clearance", state)
    return known & (clearance < (emap.cfg.levels.min_gap if height is None else height) - ROUNDING)
