"""The height update: one scan's points of a cell become one estimate, which the cell takes or rejects."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.masks import count
from torchelev.stages.cells import cells_of
from torchelev.stages.fast_layers import layers_to_change
from torchelev.stages.fusion.config import FusionConfig
from torchelev.stages.fusion.native import can_update_in_cpp, update_in_cpp
from torchelev.stages.fusion.on_gpu import OWN, can_update_on_gpu, update_on_gpu
from torchelev.stages.fusion.points import CellLayers, HitPoints
from torchelev.stages.fusion.update import update_all
from torchelev.stages.pose_error import relative_variance
from torchelev.state import MASKS, MapState, Measurement, tally


def fuse(
    state: MapState,
    m: Measurement,
    grid: GridConfig,
    cfg: FusionConfig,
    has_rays: bool,
    into: MapState | None = None,
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

    `into`: a state whose layers may be overwritten, its masks bytes; for C++ it holds the layers of `state`. Those that
    C++ or kernels write into it are part of the returned state, which keeps the masks of `state` where C++ writes them.
    """
    cells = cells_of(state, m, grid)
    noise = m.variance if m.noise is None else m.noise
    points = HitPoints(m.points, noise, relative_variance(state, m), m.origin, cells)
    settings = grid, cfg, has_rays
    if can_update_in_cpp(state):
        new = update_in_cpp(points, layers_to_change(state, CellLayers._fields, into), *settings)
    elif can_update_on_gpu(state, m.points):
        new = update_on_gpu(points, flat_layers(state), *settings, None if into is None else free_layers(state, into))
    else:
        new = update_all(points, flat_layers(state), *settings)
    shape = state.elevation.shape
    layers: dict[str, Any] = {n: x if x.shape == shape else x.view(shape) for n, x in new.layers._asdict().items()}
    if into is not None and can_update_in_cpp(state):
        layers["validity"] = state.validity
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


def free_layers(state: MapState, into: MapState) -> dict[str, Tensor]:
    """Return those layers of `into` that the results may be written into while the cells of `state` are read."""
    numbers = [name for name in CellLayers._fields if name not in MASKS]
    return {n: getattr(into, n) for n in numbers if n in OWN or getattr(into, n) is not getattr(state, n)}
