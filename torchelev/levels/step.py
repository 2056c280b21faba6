"""What an update does to levels, by tensors: the definition."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import locate
from torchelev.levels.clusters import Clusters, find_clusters, in_cells
from torchelev.levels.config import LevelsConfig
from torchelev.levels.ground import choose_ground, find_standing
from torchelev.levels.rays import Sight, SightGrid, floats, free_height, look, nearest_around
from torchelev.levels.state import Levels, LevelStatistics, age, move, remove
from torchelev.levels.surfaces import GATE, Found, distance, fuse, insert, merge
from torchelev.ops.masks import count
from torchelev.ops.transforms import is_readable
from torchelev.stages.cells import center_offsets, lattice_offset
from torchelev.state import MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.config import ElevationMapConfig

SAME = 0.1  # [m] by which points may miss the ground and still show that it is there


class Step(NamedTuple):
    """The result of an update of levels."""

    levels: Levels
    state: MapState  #: of the map: recentred, and with the ground that was chosen
    aside: Bool[Tensor, "B M"]  #: points that do not measure the ground
    statistics: LevelStatistics


class _Scan(NamedTuple):
    """A scan over the window."""

    clusters: Clusters
    floating: Bool[Tensor, "B M"]  # clusters below which rays passed
    ground_floats: Bool[Tensor, "B cells"]
    sights: list[Sight]
    x: Float[Tensor, "B cells"]  # centres of the cells [m]
    y: Float[Tensor, "B cells"]


def update_levels(
    levels: Levels, shift: Int[Tensor, "B 2"], state: MapState, m: Measurement, cfg: ElevationMapConfig
) -> Step:
    """Sort the points of a scan into the ground and other surfaces, and choose which surface is the ground.

    Args:
        levels: of the maps, before their windows moved.
        shift: cells by which they moved.
        state: of the maps, recentred for this update.
        m: the measurement.
        cfg: of the maps, with levels.
    """
    assert cfg.levels is not None
    grid, own = cfg.grid, cfg.levels
    largest = max(grid.height, grid.width)
    levels = move(levels, shift.clamp(-largest, largest))
    levels = age(levels, m.dt, cfg.aging.variance_rate, cfg.fusion.max_variance)
    flat = Levels(*(part.flatten(-2) for part in levels))
    scan = _look_at(flat, state, m, cfg)
    flat, ground, aside, opened, dropped = _sort_points(flat, state, scan, cfg)
    flat, gone = merge(flat)
    touching = (flat.support > 0) & ground[:, None] & (_to_ground(flat, state) < 0.5 * own.min_gap)
    flat = remove(flat, gone | touching)
    cleared = _seen_through(flat, scan, cfg)
    flat = remove(flat, cleared)
    flat = flat._replace(free_top=torch.maximum(flat.free_top, free_height(scan.sights, scan.x, scan.y, _size(cfg))))
    unflat = Levels(*(part.unflatten(-1, (grid.height, grid.width)) for part in flat))
    state = state._replace(validity=ground.unflatten(1, (grid.height, grid.width)))
    unflat, state, changed = _choose(unflat, state, m, cfg)
    slot, inside = _slots(state, m, cfg)
    aside = inside & (aside | changed.flatten(1).gather(1, slot))
    numbers = (opened, count(cleared), count(gone | touching), dropped, count(changed))
    return Step(unflat, state, aside, LevelStatistics(*numbers))


def _size(cfg: ElevationMapConfig) -> SightGrid:
    return SightGrid.of(cfg.grid)


def _slots(state: MapState, m: Measurement, cfg: ElevationMapConfig) -> tuple[Tensor, Tensor]:
    slot, inside = locate(m.points[..., 0], m.points[..., 1], lattice_offset(state, m, cfg.grid), cfg.grid)
    return slot.to(torch.int64), inside & m.casts


def _look_at(levels: Levels, state: MapState, m: Measurement, cfg: ElevationMapConfig) -> _Scan:
    """Return the clusters of a scan, and what its rays saw."""
    assert cfg.levels is not None
    size, gap, S = _size(cfg), cfg.levels.min_gap, m.origin.shape[1]
    points, casts = m.points.unflatten(1, (S, -1)), m.casts.unflatten(1, (S, -1))
    sights = [look(points[:, s], casts[:, s], m.origin[:, s], size) for s in range(S)]
    x, y = center_offsets(state, m, cfg.grid)
    shape = state.elevation.shape
    x, y = x.expand(shape).flatten(1), y.expand(shape).flatten(1)
    slot, inside = _slots(state, m, cfg)
    noise = m.variance if m.noise is None else m.noise
    given = m.points[..., 2], torch.where(inside, noise, 1.0), slot, inside, ~m.used
    clusters = find_clusters(*given, cfg.grid.num_cells, gap)
    place = clusters.slot.clamp(max=cfg.grid.num_cells - 1)
    floating = floats(sights, x.gather(1, place), y.gather(1, place), clusters.lower.clamp(max=1e6), gap, size)
    ground_floats = floats(sights, x, y, state.elevation.flatten(1), gap, size) & state.validity.flatten(1)
    return _Scan(clusters, floating, ground_floats, sights, x, y)


def _to_ground(levels: Levels, state: MapState) -> Float[Tensor, "B L cells"]:
    """Return the distance of each surface from the ground [m]."""
    ground = state.elevation.flatten(1)[:, None]
    return distance(levels.lower, levels.upper, ground, ground)


def _sort_points(
    levels: Levels, state: MapState, scan: _Scan, cfg: ElevationMapConfig
) -> tuple[Levels, Tensor, Tensor, Tensor, Tensor]:
    """Sort clusters into the ground, surfaces that are there, and new ones.

    Returns:
        The levels, which cells still have a ground (B, cells), which points are set aside (B, M), and the numbers of
        surfaces that were opened and dropped.
    """
    own, clusters, num_cells = cfg.levels, scan.clusters, cfg.grid.num_cells
    assert own is not None
    g, known = state.elevation.flatten(1), state.validity.flatten(1)
    demoted = known & scan.ground_floats & _shows_ground(clusters, g, own, num_cells)
    levels, lost = insert(levels, demoted, _as_found(state, own), state.time.flatten(1))
    dropped, opened, known = count(lost), count(demoted), known & ~demoted
    aside_of = torch.zeros_like(clusters.slot, dtype=torch.bool)
    for rank in range(2 * own.max_levels):
        there = in_cells(clusters.number, clusters, rank, num_cells, 0.0)
        found = _found_of(clusters, rank, cfg)
        ramp, flies = (
            in_cells(mask.to(there.dtype), clusters, rank, num_cells, 0.0) > 0
            for mask in (clusters.above_ramp, scan.floating)
        )
        dg = torch.where(known, distance(found.lower, found.upper, g, g), torch.inf)
        away = distance(found.lower[:, None], found.upper[:, None], levels.lower, levels.upper)
        dl, nearest = torch.where(levels.support > 0, away, torch.inf).min(1)
        to_ground = (dg <= own.min_gap) & (dg <= dl)
        to_level = (there > 0) & ~to_ground & (dl <= own.min_gap)
        above = known & (found.lower > g)
        shown = torch.where(known & ~above, scan.ground_floats, flies | (above & (levels.free_top >= g + own.min_gap)))
        if own.separation == "gap":
            shown = shown | known | (rank > 0)
        opens = (there > 0) & ~to_ground & ~to_level & (shown | ramp)
        chosen = torch.zeros_like(levels.support, dtype=torch.bool).scatter(1, nearest[:, None], to_level[:, None])
        levels = fuse(levels, chosen, found, cfg.fusion.max_support)
        levels, lost = insert(levels, opens, found, 0.0)
        dropped, opened = dropped + count(lost), opened + count(opens)
        other = torch.nn.functional.pad(to_level | opens, (0, 1))
        aside_of = aside_of | ((clusters.rank == rank) & other.gather(1, clusters.slot))
    return levels, known, aside_of.gather(1, clusters.of_point), opened, dropped


def _shows_ground(clusters: Clusters, g: Tensor, own: LevelsConfig, num_cells: int) -> Bool[Tensor, "B cells"]:
    """Return in which cells points show that the ground is there, or lie below it, and none that it is solid."""
    place = clusters.slot.clamp(max=num_cells - 1)
    height, part = g.gather(1, place), 0.25 * own.min_gap
    hits = (clusters.lower <= height + SAME) & (clusters.upper >= height - SAME) & (clusters.lower >= height - part)
    below = clusters.upper < height - own.min_gap
    solid = (clusters.lower < height - part) & (clusters.upper >= height - own.min_gap)

    def any_of(mask: Tensor) -> Tensor:
        table = g.new_zeros(len(g), num_cells + 1)
        return table.scatter_reduce(1, clusters.slot, mask.to(g.dtype), "amax")[:, :num_cells] > 0

    return any_of(hits | below) & ~any_of(solid)


def _as_found(state: MapState, own: LevelsConfig) -> Found:
    """Return the ground as a surface."""
    g, variance = state.elevation.flatten(1), state.variance.flatten(1)
    return Found(g, g, g, variance, variance, state.support.flatten(1).clamp(min=own.min_support))


def _found_of(clusters: Clusters, rank: int, cfg: ElevationMapConfig) -> Found:
    """Return the clusters of a rank by cell."""
    n = cfg.grid.num_cells
    weight = in_cells(clusters.weight, clusters, rank, n, 1.0)
    number = in_cells(clusters.number, clusters, rank, n, 0.0)
    lower, upper, mean = (
        in_cells(v, clusters, rank, n, 0.0) for v in (clusters.lower, clusters.upper, clusters.mean)
    )
    variance = (1 / weight).clamp(min=cfg.fusion.scan_variance_floor)
    return Found(lower, upper, mean, variance, number / weight, number)


def _seen_through(levels: Levels, scan: _Scan, cfg: ElevationMapConfig) -> Bool[Tensor, "B L cells"]:
    """Return the surfaces through which rays passed that were not hit for `raycast.min_time`.

    A ray shows it only where it crosses the surface within the cell: a thin one must be met steeply, and passed by more
    than the noise.
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
            noise = GATE * levels.variance[:, k].sqrt() + (d / size.elevations) * (1 + slope).square()
            is_thick, is_steep = tall >= 2 * noise, 1.5 * size.resolution * slope >= noise
            behind = nearest - d
            passes = (behind >= MARGIN_CELLS * size.resolution) & (is_thick | (is_steep & (behind * slope >= noise)))
            through = through | (passes & (nearest < torch.inf) & (d >= 3.0 * size.resolution))
        parts.append(through)
    return old & torch.stack(parts, 1)


MARGIN_CELLS = 1.5  # behind a surface that a ray must reach


def _choose(
    levels: Levels, state: MapState, m: Measurement, cfg: ElevationMapConfig
) -> tuple[Levels, MapState, Bool[Tensor, "B H W"]]:
    """Make the surface that the robot reaches first the ground, and return where it changed."""
    own = cfg.levels
    assert own is not None
    if m.base is None:
        return levels, state, torch.zeros_like(state.validity)
    heights = torch.cat([state.elevation[:, None], levels.upper], 1)
    known = torch.cat([state.validity[:, None], levels.support >= max(own.min_support, 0.5)], 1)
    x, y = center_offsets(state, m, cfg.grid)
    square = (x - m.base[:, 0, None, None]).square() + (y - m.base[:, 1, None, None]).square()
    standing = find_standing(heights, known, m.base, square.expand_as(state.elevation))
    first, reached = choose_ground(heights, known, standing, cfg.grid, own, is_readable(state.elevation))
    levels, state, changed = swap(levels, state, first)
    if cfg.overlap is not None:
        strange = state.validity & ~reached & ~changed & (state.time > 0) & standing.found[:, None, None]
        strange = strange & ((state.elevation - standing.height[:, None, None]).abs() > cfg.overlap.height)
        strange = strange & (square <= cfg.overlap.radius**2)
        found = Found(*(part.unflatten(1, state.elevation.shape[1:]) for part in _as_found(state, own)))
        levels, _ = insert(levels, strange, found, state.time)
        state = state._replace(validity=state.validity & ~strange)
    return levels, state, changed


def swap(
    levels: Levels, state: MapState, surface: Tensor
) -> tuple[Levels, MapState, Bool[Tensor, "B H W"]]:
    """Exchange the ground of each cell with the level `surface` - 1, where that is one; return where."""
    changed = surface > 0
    at = (surface - 1).clamp(min=0)[:, None]
    lower, upper, variance, support, time = (getattr(levels, name).gather(1, at)[:, 0] for name in levels._fields[:5])
    placed = torch.zeros_like(levels.support, dtype=torch.bool).scatter(1, at, changed[:, None])
    old = dict(
        lower=state.elevation,
        upper=state.elevation,
        variance=state.variance,
        support=torch.where(state.validity, state.support.clamp(min=1.0), 0.0),
        time=state.time,
    )
    old = {name: torch.where(state.validity, value, 0.0) for name, value in old.items()}
    levels = levels._replace(
        **{name: torch.where(placed, value[:, None], getattr(levels, name)) for name, value in old.items()},
        free_top=torch.where(changed, -torch.inf, levels.free_top),
    )
    state = state._replace(
        elevation=torch.where(changed, upper, state.elevation),
        variance=torch.where(changed, variance, state.variance),
        support=torch.where(changed, support, state.support),
        time=torch.where(changed, time, state.time),
        validity=state.validity | changed,
        bounded=state.bounded & ~changed,
        challenger_support=torch.where(changed, 0, state.challenger_support),
    )
    return levels, state, changed
