"""What an update does to levels, by tensors: the definition."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import locate
from torchelev.levels.choice import choose_surfaces
from torchelev.levels.clusters import find_clusters, in_cells
from torchelev.levels.rays import (
    MARGIN,
    NEAREST,
    SightGrid,
    floats,
    look,
    nearest_around,
    raise_free_top,
    ray_heights,
)
from torchelev.levels.sorting import Scan, sort_points
from torchelev.levels.state import Levels, LevelStatistics, age, remove
from torchelev.levels.surfaces import GATE, distance, merge
from torchelev.ops.masks import count
from torchelev.stages.cells import center_offsets, lattice_offset
from torchelev.state import MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Bool

    from torchelev.config import ElevationMapConfig

GROUND = ("elevation", "variance", "validity", "support", "challenger_support", "time", "bounded")


class Step(NamedTuple):
    """The result of an update of levels."""

    levels: Levels  #: after it
    state: MapState  #: of the map: recentred, and with the ground that was chosen
    aside: Bool[Tensor, "B M"]  #: points that do not measure the ground
    statistics: LevelStatistics  #: what it did


def update_levels(levels: Levels, state: MapState, m: Measurement, cfg: ElevationMapConfig) -> Step:
    """Sort the points of a scan into the ground and other surfaces, and choose which surface is the ground.

    Args:
        levels: in the windows of the state.
        state: of the maps, recentred for this update.
        m: the measurement.
        cfg: of the maps, with levels.
    """
    assert cfg.levels is not None
    grid, own = cfg.grid, cfg.levels
    size = (grid.height, grid.width)
    levels = age(levels, m.dt, cfg.aging.variance_rate, cfg.fusion.max_variance)
    slot, inside = _slots(state, m, cfg)
    scan = _look_at(state, m, slot, inside, cfg)
    levels = Levels(*(part.flatten(-2) for part in levels))
    state = state._replace(**{name: getattr(state, name).flatten(1) for name in GROUND})
    points = sort_points(levels, state, scan, cfg)
    (levels, met), state = merge(points.levels), points.state
    away = distance(levels.lower, levels.upper, state.elevation[:, None], state.elevation[:, None])
    met = met | ((levels.support > 0) & state.validity[:, None] & (away < 0.5 * own.min_gap))
    levels = remove(levels, met)
    cleared = _seen_through(levels, scan, cfg)
    levels = remove(levels, cleared)
    highest, lowest = scan.rays
    is_firm = state.validity & (state.support >= own.least_support)
    opens = is_firm & (lowest < state.elevation + 0.5 * own.min_gap) & (highest >= state.elevation + own.min_gap)
    points_floor = in_cells(scan.clusters.lower, scan.clusters, 0, grid.num_cells, torch.inf)
    floor = torch.where(state.validity, state.elevation, torch.minimum(points_floor, lowest))
    given = scan.sights, scan.x, scan.y, own.min_gap, _size(cfg)
    levels = levels._replace(free_top=raise_free_top(levels.free_top, floor, *given), is_open=levels.is_open | opens)
    levels, state, changed = choose_surfaces(points._replace(levels=levels), m, scan, cfg)
    aside = inside & (points.aside | changed.gather(1, slot))
    return Step(
        Levels(*(part.unflatten(-1, size) for part in levels)),
        state._replace(**{name: getattr(state, name).unflatten(1, size) for name in GROUND}),
        aside,
        LevelStatistics(points.opened, count(cleared), count(met), points.dropped, count(changed)),
    )


def _size(cfg: ElevationMapConfig) -> SightGrid:
    return SightGrid.of(cfg.grid)


def _slots(state: MapState, m: Measurement, cfg: ElevationMapConfig) -> tuple[Tensor, Tensor]:
    slot, inside = locate(m.points[..., 0], m.points[..., 1], lattice_offset(state, m, cfg.grid), cfg.grid)
    return slot.to(torch.int64), inside & m.casts


def _look_at(state: MapState, m: Measurement, slot: Tensor, inside: Tensor, cfg: ElevationMapConfig) -> Scan:
    """Return the clusters of a scan, and what its rays saw."""
    assert cfg.levels is not None
    size, gap, S = _size(cfg), cfg.levels.min_gap, m.origin.shape[1]
    points, casts = m.points.unflatten(1, (S, -1)), m.casts.unflatten(1, (S, -1))
    points, origin = points.detach(), m.origin.detach()  # what rays show are choices, which have no gradients
    sights = [look(points[:, s], casts[:, s], origin[:, s], size) for s in range(S)]
    x, y = center_offsets(state, m, cfg.grid)
    shape = state.elevation.shape
    x, y = x.expand(shape).flatten(1), y.expand(shape).flatten(1)
    noise = m.variance if m.noise is None else m.noise
    given = m.points[..., 2], torch.where(inside, noise, 1.0), slot, inside, ~m.used
    clusters = find_clusters(*given, cfg.grid.num_cells, gap)
    place = clusters.slot.clamp(max=cfg.grid.num_cells - 1)
    rays, lower = ray_heights(sights, x, y, size), clusters.lower.clamp(max=1e6)
    floating = floats(sights, x.gather(1, place), y.gather(1, place), lower, rays.lowest.gather(1, place), gap, size)
    ground_floats = floats(sights, x, y, state.elevation.flatten(1), rays.lowest, gap, size)
    return Scan(clusters, floating, ground_floats & state.validity.flatten(1), sights, rays, x, y)


def _seen_through(levels: Levels, scan: Scan, cfg: ElevationMapConfig) -> Bool[Tensor, "B L cells"]:
    """Return the surfaces through which rays passed that were not hit for `raycast.min_time`.

    A ray shows it only where it crosses the surface within the cell: a thin one must be met steeply, and passed by more
    than the noise and the height of a bin of directions.
    """
    gone = torch.zeros_like(levels.support, dtype=torch.bool)
    if cfg.raycast is None:
        return gone
    size = _size(cfg)
    old = (levels.support > 0) & (levels.time > cfg.raycast.min_time)
    parts = []
    for k in range(gone.shape[1]):
        middle, tall = 0.5 * (levels.lower[:, k] + levels.upper[:, k]), levels.upper[:, k] - levels.lower[:, k]
        through = torch.zeros_like(gone[:, 0])
        for sight in scan.sights:
            nearest, d = nearest_around(sight, scan.x, scan.y, middle, size)
            slope = (middle - sight.origin[:, 2, None]).abs() / d.clamp(min=size.resolution)
            noise = GATE * levels.variance[:, k].sqrt() + (2 * d / size.elevations) * (1 + slope).square()
            is_thick, is_steep = tall >= 2 * noise, 2 * MARGIN * size.resolution * slope >= noise
            behind = nearest - d
            crosses = is_thick | (is_steep & (behind * slope >= noise))
            passes = (behind >= MARGIN * size.resolution) & crosses
            through = through | (passes & (nearest < torch.inf) & (d >= NEAREST * size.resolution))
        parts.append(through)
    return old & torch.stack(parts, 1)
