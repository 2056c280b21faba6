"""Normals and the analytic rating of every known cell, from the planes of two windows."""

from __future__ import annotations

from torchelev.grid import GridConfig
from torchelev.plane_fit import known_ground, normals
from torchelev.stages.surface.config import SurfaceConfig
from torchelev.stages.surface.upper_bound import normals_of_upper_bound, rate_upper_bound
from torchelev.state import MapState
from torchelev.traversability.heads import (
    LearnedTraversabilityConfig,
    TraversabilityConfig,
    traversability,
)


def rate_surface(
    state: MapState,
    grid: GridConfig,
    cfg: SurfaceConfig,
    head: TraversabilityConfig | LearnedTraversabilityConfig | None,
) -> MapState:
    """Compute the normals (paper, Sec. II-A), and the traversability of the analytic head.

    Without it the traversability is left as it is: blank without any head, else for `pipeline.rate_learned`.
    """
    analytic = head if isinstance(head, TraversabilityConfig) else None
    cells = 0 if analytic is None else analytic.cells(grid)
    ground = known_ground(state.elevation, state.validity, max(cfg.radius, cells))
    if (bound := cfg.upper_bound) is not None:
        state = state._replace(**normals_of_upper_bound(state, bound.dilation, grid.resolution)._asdict())
        if bound.filter_weights is not None:
            return rate_upper_bound(state, bound.dilation, str(bound.filter_weights))
    else:
        state = state._replace(**normals(ground, state.validity, cfg.radius, grid.resolution)._asdict())
    if analytic is None:
        return state
    rating = traversability(ground, state.validity, cells, grid.resolution, analytic.critical)
    return state._replace(**rating._asdict())
