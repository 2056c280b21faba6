"""Ceilings: where the robot does not fit below what hangs above the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.elevation_map import ElevationMap
from torchelev.levels.config import is_too_low, needed_height
from torchelev.planning.polygons import PolygonCells
from torchelev.planning.terrain.ground import read_patches
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


def too_low(emap: ElevationMap, height: float | None, state: MapState | None = None) -> Bool[Tensor, "B H W"] | None:
    """Return the cells whose known clearance is less than `needed_height`; None of a map without levels.

    Args:
        emap: the maps.
        height: of the robot [m]; None: `min_gap` of the levels.
        state: the state to read; None: that of the maps.

    Raises:
        ValueError: if a height is given for a map without levels.
    """
    needed = needed_height(emap.cfg.levels, height)
    if emap.levels is None:
        return None
    clearance, known = emap.read_layer("clearance", state)
    return known & is_too_low(clearance, needed)


def describe_ceiling(ceiling: float, needed: float) -> list[str]:
    """Return a sentence if a ceiling [m] above the ground is lower than it must be."""
    is_low = is_too_low(ceiling, needed)
    return [f"what hangs {ceiling:.2f} m above the ground is lower than the robot's {needed:.2f} m"] if is_low else []


def lowest_ceiling(emap: ElevationMap, cells: PolygonCells, state: MapState | None) -> Float[Tensor, "B P"]:
    """Return the clearance of the cell with the lowest ceiling of each polygon [m]; infinite where none is known."""
    if emap.levels is None:
        current = emap.state if state is None else state
        return torch.full(cells.inside.shape[:2], torch.inf, device=emap.device, dtype=current.elevation.dtype)
    clearance, known = read_patches(*emap.read_layer("clearance", state), cells, emap.cfg.grid)
    return torch.where(known, clearance, torch.inf).flatten(-2).amin(-1)
