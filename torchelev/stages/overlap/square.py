"""Overlap clearance in a square, by the height of the sensor."""

from __future__ import annotations

import torch

from torchelev.grid import GridConfig
from torchelev.ops.masks import count
from torchelev.stages.overlap.config import SquareConfig
from torchelev.state import MapState, Measurement, tally


def clear_square(state: MapState, m: Measurement, grid: GridConfig, cfg: SquareConfig) -> MapState:
    """Clear the cells in the window's middle whose height differs by more than `height` from the first sensor's.

    Of known cells the elevation counts, of others the upper bound.
    """
    near = torch.zeros_like(state.validity)
    rows, columns = (_middle(size, cfg.side / grid.resolution) for size in (grid.height, grid.width))
    near[:, rows, columns] = True
    sensor = m.origin[:, 0, 2, None, None]
    gone = near & state.validity & ((state.elevation - sensor).abs() > cfg.height)
    unbounded = near & state.bounded & ((state.upper_bound - sensor).abs() > cfg.height)
    state = state._replace(validity=state.validity & ~gone, bounded=state.bounded & ~unbounded)
    return tally(state, cleared_other_floors=count(gone))


def _middle(size: int, cells: float) -> slice:
    half = min(int(cells) // 2, size // 2)
    return slice(size // 2 - half, size // 2 + half)
