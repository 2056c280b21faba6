"""The paper's overview figure: the stages in their order."""

from __future__ import annotations

import torch
from torch import Tensor

from torchelev.config import ElevationMapConfig
from torchelev.ops.masks import count
from torchelev.stages.age.stage import age
from torchelev.stages.compensate.stage import compensate
from torchelev.stages.fusion.stage import fuse
from torchelev.stages.measure.stage import measure
from torchelev.stages.overlap.stage import clear_other_floors
from torchelev.stages.recenter.stage import recenter
from torchelev.stages.surface.stage import rate_planes
from torchelev.stages.visibility.stage import clear_seen_through
from torchelev.state import CARRIED, MapState, Measurement, map_layers, tally
from torchelev.traversability.heads import TraversabilityConfig, learned_rating, rate_all
from torchelev.traversability.weight_file import Weights


def forward(state: MapState, m: Measurement, cfg: ElevationMapConfig, weights: Weights | None = None) -> MapState:
    """Run the stages in their order (paper, Fig. 2). Pure: changes none of its arguments. `weights` are the head's."""
    state = reset_statistics(state, m)
    state = recenter(state, m, cfg.grid)
    state = age(state, m, cfg.aging)
    state = compensate(state, m, cfg.grid, cfg.drift, cfg.drift_gate)
    state = fuse(state, m, cfg.grid, cfg.fusion, has_rays=cfg.raycast is not None)
    state = clear_seen_through(state, m, cfg.grid, cfg.raycast)
    state = clear_other_floors(state, m, cfg.grid, cfg.overlap)
    return rate_surface(count_bounded(state), cfg, weights)


def rate_surface(
    state: MapState, cfg: ElevationMapConfig, weights: Weights | None = None, into: MapState | None = None
) -> MapState:
    """Compute normals and traversability from the elevation.

    Given a state whose masks are bytes, what C++ or a kernel computes is written into its layers. The returned state
    then has the normals and ratings from before.
    """
    head = cfg.traversability
    analytic = head if isinstance(head, TraversabilityConfig) else None
    layers = rate_planes(state.elevation, state.validity, cfg.grid, cfg.surface, analytic, into)
    state = state._replace(**layers)
    if head is None:
        return rate_all(state)
    if isinstance(head, TraversabilityConfig):
        return state
    assert weights is not None
    rating = learned_rating(state, cfg.grid, head, weights)
    return state._replace(traversability=rating.traversability, rated=state.validity)


def reset_statistics(state: MapState, m: Measurement) -> MapState:
    """Set the statistics to zero, and to what the sensor's gates rejected; keep those that the next update reads."""
    gates = ("rejected_invalid", "rejected_range", "rejected_body", "rejected_overhang")
    zeros = {n: torch.zeros_like(value) for n, value in state.statistics._asdict().items() if n not in CARRIED}
    return tally(state, **(zeros | {name: getattr(m, name) for name in gates}))


def count_bounded(state: MapState) -> MapState:
    """Count the unknown cells that have an upper bound."""
    return tally(state, cells_bounded=count(state.bounded & ~state.validity))


def update_in_place(
    stored: MapState,
    points: Tensor,
    T_map_sensor: Tensor,
    T_map_base: Tensor | None,
    dt: Tensor,
    variance: Tensor | None,
    T_base_links: Tensor | None,
    pose_covariance: Tensor | None = None,
    *,
    cfg: ElevationMapConfig,
    weights: Weights | None = None,
) -> None:
    """Measure, fuse, and write the new values into the stored state's own tensors; points come as (B, S, N, 3)."""
    inputs = points, T_map_sensor, T_map_base, dt, variance, T_base_links, pose_covariance
    m = measure(*inputs, cfg.grid, cfg.sensor, stored.elevation.dtype)
    write(stored, forward(stored, m, cfg, weights))


def write(stored: MapState, new: MapState) -> None:
    """Copy the new values into the stored state's own tensors."""
    map_layers(Tensor.copy_, stored, new)
