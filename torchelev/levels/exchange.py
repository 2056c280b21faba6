"""The ground of a map and its levels change places."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.levels.ground import NONE
from torchelev.levels.state import Levels, forget_space, remove
from torchelev.levels.surfaces import Found
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Int

    from torchelev.config import ElevationMapConfig


def as_found(state: MapState, cfg: ElevationMapConfig) -> Found:
    """Return the ground as a surface, without what the disagreement of scans adds to its variance."""
    assert cfg.levels is not None
    g, disagreement = state.elevation, state.statistics.disagreement.square()[:, None]
    variance = (state.variance - disagreement).clamp(min=cfg.fusion.scan_variance_floor)
    return Found(g, g, g, variance, variance, state.support.clamp(min=cfg.levels.min_support))


def forget_ground(state: MapState, cells: Bool[Tensor, "B cells"]) -> MapState:
    """Return a state without the ground of some cells."""
    return state._replace(
        validity=state.validity & ~cells, challenger_support=torch.where(cells, 0, state.challenger_support)
    )


def found_ground(levels: Levels, state: MapState, level: Int[Tensor, "B cells"]) -> tuple[Levels, MapState]:
    """Make a level the ground of each cell, whatever that was; NONE: it stays."""
    founds, at = level >= 0, level.clamp(min=0)[:, None]
    upper, variance, support, time = (
        getattr(levels, name).gather(1, at)[:, 0] for name in ("upper", "variance", "support", "time")
    )
    variance = variance + state.statistics.disagreement.square()[:, None]
    state = state._replace(
        elevation=torch.where(founds, upper, state.elevation),
        variance=torch.where(founds, variance, state.variance),
        support=torch.where(founds, support, state.support),
        time=torch.where(founds, time, state.time),
        validity=state.validity | founds,
        bounded=state.bounded & ~founds,
        challenger_support=torch.where(founds, 0, state.challenger_support),
    )
    gone = torch.zeros_like(levels.support, dtype=torch.bool).scatter(1, at, founds[:, None])
    return remove(levels, gone), state


def swap(
    levels: Levels, state: MapState, surface: Int[Tensor, "B cells"], cfg: ElevationMapConfig
) -> tuple[Levels, MapState, Bool[Tensor, "B cells"]]:
    """Exchange the ground of each cell with the level `surface` - 1, where that is one; return where."""
    changed, level = surface > 0, surface - 1
    ground = as_found(state, cfg)
    support = state.support.clamp(min=1.0)
    old = dict(lower=ground.mean, upper=ground.mean, variance=ground.variance, support=support, time=state.time)
    was_known = changed & state.validity
    levels, state = found_ground(levels, state, level.clamp(min=NONE))
    place = torch.zeros_like(levels.support, dtype=torch.bool)
    place = place.scatter(1, level.clamp(min=0)[:, None], was_known[:, None])
    levels = levels._replace(
        **{name: torch.where(place, value[:, None], getattr(levels, name)) for name, value in old.items()}
    )
    return forget_space(levels, changed), state, changed
