"""Which points lie on the ground of which cell: the definition by tensors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from torchelev.channels.fuse import GroundPoints
from torchelev.grid import GridConfig, locate
from torchelev.stages.cells import lattice_offset
from torchelev.stages.measure.stage import measure
from torchelev.state import MapState

if TYPE_CHECKING:
    from torchelev.inputs.update_inputs import Inputs
    from torchelev.stages.measure.config import SensorConfig


def match_points(inputs: Inputs, state: MapState, grid: GridConfig, sensor: SensorConfig) -> GroundPoints:
    """Find the cell of each point, and how far its height is from the cell's elevation after the update.

    Left out are points that `measure` leaves out.

    Args:
        inputs: of the update; M = S * N points.
        state: of the maps after the update.
        grid: the window.
        sensor: noise, range and body.
    """
    m = measure(*inputs, grid, sensor, torch.float32)
    x, y, z = m.points.unbind(-1)
    slot, inside = locate(x, y, lattice_offset(state, m, grid), grid)
    elevation, validity = (
        layer.flatten(1).gather(1, slot.to(torch.int64)) for layer in (state.elevation, state.validity)
    )
    noise = m.variance if m.noise is None else m.noise
    counts = m.used & inside & validity
    return GroundPoints(slot.to(torch.int64), counts, (z - elevation).abs(), torch.where(counts, noise, 1.0))
