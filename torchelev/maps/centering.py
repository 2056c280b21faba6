"""Moving the windows of a map to their robots, besides updates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.stages.recenter.stage import follow
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from torchelev.elevation_map import ElevationMap


def center_on(
    state: MapState, emap: ElevationMap, T_map_base: Float[Tensor, "B 4 4"], chosen: Bool[Tensor, "B"]
) -> MapState:
    """Move the windows of the chosen environments to their robots."""
    position = T_map_base[:, :3, 3].double()
    anchor = (position[:, :2] / emap.cfg.grid.resolution).floor()
    near = torch.cat([position[:, :2] - anchor * emap.cfg.grid.resolution, position[:, 2:]], 1)
    near = torch.where(chosen[:, None], near, torch.nan).to(state.elevation.dtype)
    return follow(state, near, anchor.long(), emap.cfg.grid)
