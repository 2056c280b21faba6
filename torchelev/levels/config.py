"""How many surfaces a cell holds, and what tells them apart."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from torchelev.errors import require, require_positive

if TYPE_CHECKING:
    from torchelev.grid import GridConfig

MAX_LEVELS = 8  # a cell of more is a bush
MAX_HEIGHT = 20.0  # [m] of a gap or a step; more is a number in other units
SEPARATIONS = ("rays", "gap")
ROUNDING = 1e-3  # [m] by which a ceiling may be too low


@dataclass(frozen=True, kw_only=True)
class LevelsConfig:
    """Several surfaces in each cell: the ground on which the robot stands, and those above and below it.

    Raises:
        ValueError: if a setting is out of range.
    """

    max_levels: int = 3  #: maximum number of surfaces per cell, including the ground, 1 to 8; 1: only the ground
    #: [m] minimum free height between two surfaces; a smaller gap counts as solid
    min_gap: float = 0.4
    #: evidence for free space between two surfaces: "rays" that pass through it, or only the "gap"
    separation: str = "rays"
    max_step: float = 0.3  #: [m] maximum height difference between neighbouring cells that the robot can step
    max_blind: float = 0.5  #: [m] maximum width of unknown cells across which the ground continues
    min_support: float = 3.0  #: minimum number of points for a surface to be reported or chosen as the ground

    def __post_init__(self) -> None:
        K, rule = self.max_levels, f"must be a whole number from 1 to {MAX_LEVELS}"
        is_count = isinstance(K, int) and not isinstance(K, bool) and 1 <= K <= MAX_LEVELS
        hint = "3 hold ground, table and ceiling; each more costs time and 20 bytes a cell"
        require(is_count, "levels.max_levels", rule, repr(K), hint)
        sizes = {"levels.min_gap": self.min_gap, "levels.max_step": self.max_step}
        require_positive(**sizes)
        rule = f"must be at most {MAX_HEIGHT:g} m"
        for name, value in sizes.items():
            require(value <= MAX_HEIGHT, name, rule, value, "give metres")
        known, rule = self.separation in SEPARATIONS, f"must be one of {', '.join(SEPARATIONS)}"
        require(known, "levels.separation", rule, repr(self.separation), "use rays")
        for name in ("max_blind", "min_support"):
            value = getattr(self, name)
            good = 0 <= value < math.inf
            require(good, f"levels.{name}", "must be finite and not negative", value, "leave it out for the default")

    def blind_cells(self, grid: GridConfig) -> int:
        """Return `max_blind` in cells."""
        return int(min(self.max_blind, 1e3) / grid.resolution)

    @property
    def least_support(self) -> float:
        """The support from which on a surface is there: `min_support`, and more than none."""
        return max(self.min_support, 0.5)

    @property
    def others(self) -> int:
        """How many surfaces a cell holds besides the ground, L = K - 1."""
        return self.max_levels - 1


def levels_with_ceilings(levels: LevelsConfig | None) -> LevelsConfig | None:
    """Return the levels of a map, None if it knows only the ground."""
    return levels if levels is not None and levels.others else None


def needed_height(levels: LevelsConfig | None, height: float | None) -> float:
    """Return the clearance [m] that the robot needs below ceilings: its height, and at least `min_gap`.

    The map treats a smaller gap as solid, whether or not it was seen. 0 of a map that knows only the ground.

    Args:
        levels: of the map.
        height: of the robot [m]; None: `min_gap` of the levels.

    Raises:
        ValueError: if a height is given for a map that knows only the ground.
    """
    known = levels_with_ceilings(levels)
    if known is None:
        hint = "give the map levels=LevelsConfig(), or leave it out"
        require(height is None, "height", "needs a map with levels, which knows ceilings", height, hint)
        return 0.0
    return max(known.min_gap, 0.0 if height is None else height)


def is_too_low(clearance: Any, needed: float) -> Any:
    """Return where a clearance [m], a number, tensor or array, is less than `needed_height`; NaN is not."""
    return clearance < needed - ROUNDING
