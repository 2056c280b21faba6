"""The points of a scan are sorted into the ground and other surfaces."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.levels.clusters import Clusters, in_cells
from torchelev.levels.config import LevelsConfig
from torchelev.levels.exchange import as_found, forget_ground, found_ground
from torchelev.levels.ground import NONE
from torchelev.levels.rays import (
    RayHeights,
    Sight,
)
from torchelev.levels.state import Levels
from torchelev.levels.surfaces import SETTLED, Found, distance, fuse, insert
from torchelev.ops.masks import count
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.config import ElevationMapConfig

SAME = 0.1  # [m] by which points may miss the ground and still show that it is there


class Scan(NamedTuple):
    """A scan over the window."""

    clusters: Clusters  #: of its points in each cell
    floating: Bool[Tensor, "B M"]  #: clusters below which rays passed
    ground_floats: Bool[Tensor, "B cells"]  #: cells below whose ground rays passed
    sights: list[Sight]  #: what the rays of each sensor saw
    rays: RayHeights  #: the highest and the lowest ray over each cell
    x: Float[Tensor, "B cells"]  #: [m] centres of the cells
    y: Float[Tensor, "B cells"]  #: [m] centres of the cells


class SortedPoints(NamedTuple):
    """Points that were sorted into the ground and other surfaces."""

    levels: Levels  #: with these points
    state: MapState  #: of the map, without ground below which rays passed
    aside: Bool[Tensor, "B M"]  #: points that do not measure the ground
    waiting: Float[Tensor, "B cells"]  #: number of points that will found the ground where it is not known
    height: Float[Tensor, "B cells"]  #: [m] of these
    opened: Int[Tensor, "B"]  #: surfaces found
    dropped: Int[Tensor, "B"]  #: surfaces for which a cell had no place


def sort_points(levels: Levels, state: MapState, scan: Scan, cfg: ElevationMapConfig) -> SortedPoints:
    """Sort clusters into the ground, surfaces that are there, and new ones."""
    own, clusters, num_cells = cfg.levels, scan.clusters, cfg.grid.num_cells
    assert own is not None
    levels, state, demoted, lost = _demote_floating(levels, state, scan, cfg)
    dropped, opened = count(lost), count(demoted)
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
    return SortedPoints(levels, state, aside_of.gather(1, clusters.of_point), waiting, height, opened, dropped)


def _demote_floating(
    levels: Levels, state: MapState, scan: Scan, cfg: ElevationMapConfig
) -> tuple[Levels, MapState, Bool[Tensor, "B cells"], Bool[Tensor, "B cells"]]:
    """Make ground below which rays passed a level, and return where, and where that was dropped."""
    assert cfg.levels is not None
    shown = _shows_ground(scan.clusters, state.elevation, cfg.levels, cfg.grid.num_cells)
    demoted = state.validity & scan.ground_floats & shown
    levels, lost = insert(levels, demoted, as_found(state, cfg), state.time)
    return levels._replace(is_open=levels.is_open & ~demoted), forget_ground(state, demoted), demoted, lost


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


def _found_of(clusters: Clusters, rank: int, cfg: ElevationMapConfig) -> Found:
    """Return the clusters of a rank by cell."""
    n = cfg.grid.num_cells
    weight = in_cells(clusters.weight, clusters, rank, n, 1.0)
    number = in_cells(clusters.number, clusters, rank, n, 0.0)
    lower, upper, mean = (in_cells(v, clusters, rank, n, 0.0) for v in (clusters.lower, clusters.upper, clusters.mean))
    variance = (1 / weight).clamp(min=cfg.fusion.scan_variance_floor)
    return Found(lower, upper, mean, variance, number / weight, number)
