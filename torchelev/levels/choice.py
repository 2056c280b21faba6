"""The surface that the robot reaches first becomes the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.levels.exchange import as_found, forget_ground, swap
from torchelev.levels.ground import choose_ground, find_standing
from torchelev.levels.sorting import Scan, SortedPoints
from torchelev.levels.state import Levels, forget_space
from torchelev.levels.surfaces import SETTLED, insert
from torchelev.ops.transforms import is_readable
from torchelev.state import MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Bool

    from torchelev.config import ElevationMapConfig


def choose_surfaces(
    points: SortedPoints, m: Measurement, scan: Scan, cfg: ElevationMapConfig
) -> tuple[Levels, MapState, Bool[Tensor, "B cells"]]:
    """Make the surface that the robot reaches first the ground, and return where it changed.

    Surfaces above the ground, and all where it was hit last, do not count if they have fewer points than it and are not
    SETTLED. Beside levels, the points that will found the ground where it is not known stand for it.

    Near the robot, ground of another floor that it cannot reach becomes a level too.
    """
    own, size = cfg.levels, (cfg.grid.height, cfg.grid.width)
    assert own is not None
    levels, state = points.levels, points.state
    if m.base is None:
        return levels, state, torch.zeros_like(state.validity)
    waits = (points.waiting > 0) & (levels.support > 0).any(1)
    ground = torch.where(waits, points.height, state.elevation)[:, None]
    heights = torch.cat([ground, levels.upper], 1).unflatten(2, size).detach()
    is_dust = (state.time[:, None] <= levels.time) | (levels.lower > ground) | waits[:, None]
    rival = torch.where(waits, points.waiting, torch.where(state.validity, state.support, 0.0)).clamp(max=SETTLED)
    rival = torch.where(is_dust, rival[:, None], 0.0).clamp(min=own.least_support)
    known = torch.cat([(state.validity | waits)[:, None], levels.support >= rival], 1).unflatten(2, size)
    square = (scan.x - m.base[:, 0, None]).square() + (scan.y - m.base[:, 1, None]).square()
    of_ground = torch.where(waits, 0.0, state.support)[:, None]
    support = torch.cat([of_ground, levels.support], 1).unflatten(2, size)
    standing = find_standing(heights, known, support, m.base, square.unflatten(1, size))
    first, reached = choose_ground(heights, known, standing, cfg.grid, own, is_readable(state.elevation))
    levels, state, changed = swap(levels, state, first.flatten(1), cfg)
    if cfg.overlap is not None:
        strange = state.validity & ~reached.flatten(1) & ~changed & (state.time > 0) & standing.found[:, None]
        strange = strange & ((state.elevation - standing.height[:, None]).abs() > cfg.overlap.height)
        strange = strange & (square <= cfg.overlap.radius**2)
        levels, state = _demote_strange(levels, state, strange, cfg)
    return levels, state, changed


def _demote_strange(
    levels: Levels, state: MapState, strange: Bool[Tensor, "B cells"], cfg: ElevationMapConfig
) -> tuple[Levels, MapState]:
    """Make ground of another floor a level (paper, Sec. II-F, without the forgetting)."""
    levels, _ = insert(levels, strange, as_found(state, cfg), state.time)
    return forget_space(levels, strange), forget_ground(state, strange)
