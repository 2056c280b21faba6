"""Giving back: maps start with what a site knows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.site.fusion.windows import BEFORE_ALL, Known, Told, Windows, no_alignment
from torchelev.stages.initialize import Remembered, recall
from torchelev.stages.recenter import follow
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from torchelev.elevation_map import ElevationMap

SUPPORT = 6.0  # points that must disagree until what a site remembers is replaced


def center_on(state: MapState, emap: ElevationMap, T_map_base: Float[Tensor, "B 4 4"], chosen: Tensor) -> MapState:
    """Move the windows of the chosen environments to their robots."""
    position = T_map_base[:, :3, 3].double()
    anchor = (position[:, :2] / emap.cfg.grid.resolution).floor()
    near = torch.cat([position[:, :2] - anchor * emap.cfg.grid.resolution, position[:, 2:]], 1)
    near = torch.where(chosen[:, None], near, torch.nan).to(state.elevation.dtype)
    return follow(state, near, anchor.long(), emap.cfg.grid)


def fill(
    state: MapState, emap: ElevationMap, areas: dict[str, Tensor], offset: Float[Tensor, "B"], chosen: Tensor
) -> MapState:
    """Fill the unknown cells of the chosen environments; `offset` [m] is added to the site's heights."""
    elevation, variance, time, bound = (areas[name].to(state.elevation.device) for name in Remembered._fields)
    shift = offset.to(elevation)[:, None, None]
    before = Remembered(elevation + shift, variance, time, bound + shift)
    return recall(state, before, chosen, emap.cfg.fusion.max_variance, SUPPORT)


def remember_given(
    emap: ElevationMap, windows: Windows, after: MapState, told: Told | None, chosen: Bool[Tensor, "B"], now: float
) -> Told:
    """Return what the site knows of B maps, now that the chosen ones were filled from it.

    It knows all that they know, less what they have measured and not merged yet.
    """
    known = windows.known
    is_old = after.validity & ~windows.is_new
    time = torch.full_like(known.now, now)
    given = Known(after.corner, after.elevation, after.variance, after.time, is_old, time, known.rate)
    if told is None:
        nothing = no_alignment(len(chosen), chosen.device)
        never = torch.full_like(after.elapsed, BEFORE_ALL)
        return Told(
            _clone(given),
            nothing,
            never,
            emap.num_resets.to(chosen.device, copy=True),
            torch.full_like(after.elapsed, -1),
        )

    def choose(new: Tensor, old: Tensor) -> Tensor:
        return torch.where(chosen.view(-1, *[1] * (new.ndim - 1)), new, old)

    return told._replace(known=Known(*(choose(new, old) for new, old in zip(given, told.known, strict=True))))


def _clone(known: Known) -> Known:
    return Known(*(value.clone() for value in known))
