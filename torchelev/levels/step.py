"""What an update does to levels, by tensors: the definition."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import locate
from torchelev.levels.clusters import Clusters, find_clusters, in_cells
from torchelev.levels.config import LevelsConfig
from torchelev.levels.ground import NONE, choose_ground, find_standing
from torchelev.levels.rays import (
    MARGIN,
    NEAREST,
    RayHeights,
    Sight,
    SightGrid,
    floats,
    look,
    nearest_around,
    raise_free_top,
    ray_heights,
)
from torchelev.levels.state import Levels, LevelStatistics, age, forget_space, remove
from torchelev.levels.surfaces import GATE, SETTLED, Found, distance, fuse, insert, merge
from torchelev.ops.masks import count
from torchelev.ops.transforms import is_readable
from torchelev.stages.cells import center_offsets, lattice_offset
from torchelev.state import MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.config import ElevationMapConfig

GROUND = ("elevation", "variance", "validity", "support", "challenger_support", "time", "bounded")
SAME = 0.1  # [m] by which points may miss the ground and still show that it is there


class Step(NamedTuple):
    """The result of an update of levels."""

    levels: Levels  #: after it
    state: MapState  #: of the map: recentred, and with the ground that was chosen
    aside: Bool[Tensor, "B M"]  #: points that do not measure the ground
    statistics: LevelStatistics  #: what it did


class _Sorted(NamedTuple):
    """Points that were sorted into the ground and other surfaces."""

    levels: Levels
    state: MapState
    aside: Bool[Tensor, "B M"]  # points that do not measure the ground
    waiting: Float[Tensor, "B cells"]  # points that will found the ground where that is not known
    height: Float[Tensor, "B cells"]  # [m] of these
    opened: Int[Tensor, "B"]
    dropped: Int[Tensor, "B"]


class _Scan(NamedTuple):
    """A scan over the window."""

    clusters: Clusters
    floating: Bool[Tensor, "B M"]  # clusters below which rays passed
    ground_floats: Bool[Tensor, "B cells"]
    sights: list[Sight]
    rays: RayHeights
    x: Float[Tensor, "B cells"]  # centres of the cells [m]
    y: Float[Tensor, "B cells"]


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
    points = _sort_points(levels, state, scan, cfg)
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
    levels, state, changed = _choose(points._replace(levels=levels), m, scan, cfg)
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


def _look_at(state: MapState, m: Measurement, slot: Tensor, inside: Tensor, cfg: ElevationMapConfig) -> _Scan:
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
    return _Scan(clusters, floating, ground_floats & state.validity.flatten(1), sights, rays, x, y)


def _sort_points(levels: Levels, state: MapState, scan: _Scan, cfg: ElevationMapConfig) -> _Sorted:
    """Sort clusters into the ground, surfaces that are there, and new ones."""
    own, clusters, num_cells = cfg.levels, scan.clusters, cfg.grid.num_cells
    assert own is not None
    demoted = state.validity & scan.ground_floats & _shows_ground(clusters, state.elevation, own, num_cells)
    levels, lost = insert(levels, demoted, _as_found(state, cfg), state.time)
    levels = levels._replace(is_open=levels.is_open & ~demoted)
    state, dropped, opened = _forget_ground(state, demoted), count(lost), count(demoted)
    aside_of = torch.zeros_like(clusters.slot, dtype=torch.bool)
    waiting, height = torch.zeros_like(state.elevation), state.elevation
    for rank in range(2 * own.max_levels):
        there = in_cells(clusters.number, clusters, rank, num_cells, 0.0)
        found = _found_of(clusters, rank, cfg)
        ramp, flies = (
            in_cells(mask.to(there.dtype), clusters, rank, num_cells, 0.0) > 0
            for mask in (clusters.above_ramp, scan.floating)
        )
        g, known = state.elevation, state.validity
        dg = torch.where(known, distance(found.lower, found.upper, g, g), torch.inf)
        away = distance(found.lower[:, None], found.upper[:, None], levels.lower, levels.upper)
        is_near = away <= torch.where(levels.support < SETTLED, SAME, torch.inf)
        dl, nearest = torch.where((levels.support > 0) & is_near, away, torch.inf).min(1)
        to_ground = (dg <= own.min_gap) & (dg <= dl)
        to_level = (there > 0) & ~to_ground & (dl <= own.min_gap)
        above = known & (found.lower > g)
        shown = torch.where(known & ~above, scan.ground_floats, flies | (above & levels.is_open))
        if own.separation == "gap":
            shown = shown | known | (rank > 0)
        opens = (there > 0) & ~to_ground & ~to_level & (shown | (ramp & ~known))
        chosen = torch.zeros_like(levels.support, dtype=torch.bool).scatter(1, nearest[:, None], to_level[:, None])
        stands = to_level & ~known & ~ramp & ~flies & (found.lower < levels.lower.gather(1, nearest[:, None])[:, 0])
        levels = fuse(levels, chosen, found, cfg.fusion.max_support)
        levels, state = found_ground(levels, state, torch.where(stands, nearest, NONE))
        waits = (there > 0) & ~to_level & ~opens & ~known & (waiting == 0)
        waiting, height = torch.where(waits, there, waiting), torch.where(waits, found.mean, height)
        levels, lost = insert(levels, opens, found, 0.0)
        dropped, opened = dropped + count(lost), opened + count(opens)
        other = torch.nn.functional.pad(to_level | opens, (0, 1))
        aside_of = aside_of | ((clusters.rank == rank) & other.gather(1, clusters.slot))
    return _Sorted(levels, state, aside_of.gather(1, clusters.of_point), waiting, height, opened, dropped)


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


def _as_found(state: MapState, cfg: ElevationMapConfig) -> Found:
    """Return the ground as a surface, without what the disagreement of scans adds to its variance."""
    assert cfg.levels is not None
    g, disagreement = state.elevation, state.statistics.disagreement.square()[:, None]
    variance = (state.variance - disagreement).clamp(min=cfg.fusion.scan_variance_floor)
    return Found(g, g, g, variance, variance, state.support.clamp(min=cfg.levels.min_support))


def _forget_ground(state: MapState, cells: Bool[Tensor, "B cells"]) -> MapState:
    return state._replace(
        validity=state.validity & ~cells, challenger_support=torch.where(cells, 0, state.challenger_support)
    )


def _found_of(clusters: Clusters, rank: int, cfg: ElevationMapConfig) -> Found:
    """Return the clusters of a rank by cell."""
    n = cfg.grid.num_cells
    weight = in_cells(clusters.weight, clusters, rank, n, 1.0)
    number = in_cells(clusters.number, clusters, rank, n, 0.0)
    lower, upper, mean = (in_cells(v, clusters, rank, n, 0.0) for v in (clusters.lower, clusters.upper, clusters.mean))
    variance = (1 / weight).clamp(min=cfg.fusion.scan_variance_floor)
    return Found(lower, upper, mean, variance, number / weight, number)


def _seen_through(levels: Levels, scan: _Scan, cfg: ElevationMapConfig) -> Bool[Tensor, "B L cells"]:
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


def _choose(
    points: _Sorted, m: Measurement, scan: _Scan, cfg: ElevationMapConfig
) -> tuple[Levels, MapState, Bool[Tensor, "B cells"]]:
    """Make the surface that the robot reaches first the ground, and return where it changed.

    Surfaces above the ground, and all where it was hit last, do not count if they have fewer points than it and are not
    SETTLED. Beside levels, the points that will found the ground where it is not known stand for it.

    Near the robot, ground of another floor that it cannot reach becomes a level too (paper, Sec. II-F, without the
    forgetting).
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
        levels, _ = insert(levels, strange, _as_found(state, cfg), state.time)
        levels, state = forget_space(levels, strange), _forget_ground(state, strange)
    return levels, state, changed


def swap(
    levels: Levels, state: MapState, surface: Int[Tensor, "B cells"], cfg: ElevationMapConfig
) -> tuple[Levels, MapState, Bool[Tensor, "B cells"]]:
    """Exchange the ground of each cell with the level `surface` - 1, where that is one; return where."""
    changed, level = surface > 0, surface - 1
    ground = _as_found(state, cfg)
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
