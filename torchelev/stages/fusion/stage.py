"""The height update: one scan's points of a cell become one estimate, which the cell takes or rejects."""

from __future__ import annotations

from typing import Any

from torchelev.grid import GridConfig
from torchelev.ops.masks import count
from torchelev.stages.cells import cells_of
from torchelev.stages.fusion.average import average
from torchelev.stages.fusion.config import FusionConfig
from torchelev.stages.fusion.points import CellLayers, HitPoints
from torchelev.stages.fusion.update import update_all
from torchelev.stages.pose_error import relative_variance
from torchelev.state import MapState, Measurement, tally


def fuse(
    state: MapState,
    m: Measurement,
    grid: GridConfig,
    cfg: FusionConfig,
    has_rays: bool,
) -> MapState:
    """Fuse the scan into the map (paper, Sec. II-C).

    The points of a cell become one height z_s with the variance R (`measure_cells`): those within the Mahalanobis gate
    of the cell's elevation if most points agree with it, else those around the scan's own robust mean. In a cell that
    holds a step, `edges.side_of_step` decides which side counts. The points of one scan share the error of its pose, so
    R has a floor.

    Equations (1) and (2) then update the cell once, in a form that does not depend on the order of the points
    (`update_cells`):

        h <- h + K (z_s - h),    sigma_m^2 <- K R,    K = sigma_m^2 / (sigma_m^2 + R).

    Each cell counts the points that agree with it, less those that do not (majority vote of Boyer and Moore). The
    height that most points support wins, even if the first point was an outlier. A scan that disagrees raises the
    variance, as in the paper. It replaces the cell's estimate once the count falls below zero, or once enough points
    above the cell agree with each other (`challenge`): a new obstacle appears soon, even on settled ground.
    """
    if cfg.averaging is not None:
        return average(state, m, grid, cfg.averaging, cfg.max_variance)
    cells = cells_of(state, m, grid)
    noise = m.variance if m.noise is None else m.noise
    points = HitPoints(m.points, noise, relative_variance(state, m), m.origin, cells)
    new = update_all(points, flat_layers(state), grid, cfg, has_rays)
    shape = state.elevation.shape
    layers: dict[str, Any] = {name: layer.view(shape) for name, layer in new.layers._asdict().items()}
    return tally(
        state._replace(**layers),
        points_used=new.num_used,
        rejected_outside=count(m.used & ~cells.inside),
        rejected_edge=new.num_ignored,
        rejected_outlier=count(cells.inside) - new.num_ignored - new.num_used,
    )


def flat_layers(state: MapState) -> CellLayers:
    """Return what the update reads and writes, (B, C) each."""
    return CellLayers(*(getattr(state, name).flatten(1) for name in CellLayers._fields))
