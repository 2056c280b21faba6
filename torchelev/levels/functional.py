"""An update of maps with levels as a pure function, differentiable in the heights of points and surfaces."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from torchelev.errors import require
from torchelev.levels.state import Levels, move, raise_surfaces
from torchelev.levels.step import update_levels
from torchelev.stages.measure.stage import set_aside
from torchelev.stages.recenter.stage import recenter
from torchelev.state import MapState, Measurement

if TYPE_CHECKING:
    from torchelev.config import ElevationMapConfig


def forward(
    levels: Levels,
    state: MapState,
    m: Measurement,
    cfg: ElevationMapConfig,
    run: Callable[[MapState, Measurement], MapState],
) -> tuple[MapState, Levels]:
    """Fuse a measurement into the ground and the other surfaces of maps; changes none of its arguments.

    Which surface a point measures, what is free and which surface is the ground are choices without gradients.

    Args:
        levels: in the windows of the state.
        state: of the maps before the update.
        m: the measurement.
        cfg: of the maps, with levels.
        run: the stages, for the ground.
    """
    moved = recenter(state, m, cfg.grid)
    step = update_levels(move(levels, moved.corner - state.corner), moved, m, cfg)
    state, levels = run(step.state, set_aside(m, step.aside)), step.levels
    if cfg.drift is not None:
        levels = raise_surfaces(levels, state.statistics.drift_correction.to(levels.lower.dtype))
    return state, levels


def require_levels(levels: Levels, state: MapState, cfg: ElevationMapConfig) -> None:
    """Refuse levels that do not belong to a state of maps of a config."""
    hint = "give emap.levels.in_windows(state), or what forward returned"
    others = 0 if cfg.levels is None else cfg.levels.others
    require(
        others > 0, "levels", "must be left out for a map without levels", "levels", "give the config LevelsConfig()"
    )
    require(isinstance(levels, Levels), "levels", "must be Levels", type(levels).__name__, hint, TypeError)
    B, H, W = state.elevation.shape
    shape, dtype = (B, others, H, W), state.elevation.dtype
    actual = tuple(levels.lower.shape), levels.lower.dtype
    require(actual == (shape, dtype), "levels", f"expected {shape} of {dtype}", f"{actual[0]} of {actual[1]}", hint)
