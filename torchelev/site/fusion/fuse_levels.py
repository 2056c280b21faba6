"""Fusing all surfaces of windows into the cells of a site with levels."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.levels.config import LevelsConfig
from torchelev.levels.state import SURFACE, Levels
from torchelev.levels.surfaces import SETTLED
from torchelev.site.content.levels import SPACE
from torchelev.site.content.tiles import LAYERS, Tiles
from torchelev.site.fusion.entries import MIN_VARIANCE, fuse_entries, rise
from torchelev.site.fusion.fuse import Entries, Heights
from torchelev.site.fusion.join_surfaces import Cells, Surfaces, join, tidy, withdraw
from torchelev.site.fusion.pieces import Pieces
from torchelev.site.fusion.stacks import Change, Stack, compare, read_stack, windows_of
from torchelev.site.fusion.windows import Alignment, Known, Windows
from torchelev.site.site_config import SiteConfig

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.elevation_map import ElevationMap
    from torchelev.state import MapState

_GROUND = tuple(LAYERS.index(name) for name in ("elevation", "variance", "time"))
_OTHER = tuple(LAYERS.index(name) for name in ("other_elevation", "other_variance", "other_time"))


class Robots(NamedTuple):
    """What B robots know at a merge, and how it lies in the site's frame."""

    windows: Windows  #: whose ground is the lowest surface
    change: Change  #: of all surfaces
    alignment: Alignment  #: of the windows
    resolution: float  #: [m]

    def faces(self, stack: Stack, place: tuple[Tensor, Tensor], level: int, is_before: bool) -> tuple[Heights, Heights]:
        """Return undersides and tops of surfaces at places (robots, cells of the flat windows), in the site's frame."""
        known, alignment = self.windows.known, self.alignment
        if is_before and self.windows.contribution is not None:
            known, alignment = self.windows.contribution.known, self.windows.contribution.alignment
        robot, cell = place
        above = rise(known, alignment, robot, cell, self.resolution)
        lower, upper, variance, age = (
            getattr(stack, name)[:, level].flatten()[cell] for name in ("lower", "upper", "variance", "age")
        )
        variance, time = _as_measured(known, robot, variance, age)
        return Heights(lower - above, variance, time), Heights(upper - above, variance, time)


def _as_measured(known: Known, robot: Tensor, variance: Tensor, age: Tensor) -> tuple[Tensor, Tensor]:
    """Return variances [m^2] right after the last measurements, and their times [s]."""
    variance = (variance - known.rate.float()[robot] * age).clamp(min=MIN_VARIANCE)
    return variance, (known.now[robot] - age).float()


def read_surfaces(
    emap: ElevationMap, state: MapState, windows: Windows, resolution: float, min_gap: float
) -> tuple[Windows, Change]:
    """Return the windows of a map, whose ground is the lowest surface, and all surfaces of them.

    Args:
        emap: the map.
        state: its state, as of `read_windows`.
        windows: as these were read.
        resolution: [m].
        min_gap: [m] between surfaces.
    """
    change = compare(read_stack(emap, state, windows.known), windows.contribution, state.elapsed, min_gap)
    return windows_of(windows, change, resolution), change


def fuse_levels(
    layers: Float[Tensor, "L C"],
    entries: Entries,
    robot: Int[Tensor, "K"],
    place: Int[Tensor, "K"],
    tiles: Tiles,
    robots: Robots,
    pieces: Pieces,
    rate: float,
    cfg: SiteConfig,
) -> Int[Tensor, "k"]:
    """Fuse all surfaces of robots into the layers of tiles, in place.

    Args:
        layers: of the tiles.
        entries: of the lowest surfaces.
        robot: whose entry it is.
        place: of the entries in the flat windows.
        tiles: of the site.
        robots: what they know.
        pieces: of the windows.
        rate: [m^2/s] at which variances grow.
        cfg: settings.

    Returns:
        The robots of the entries whose heights contradict other heights of the ground.
    """
    levels = tiles.levels.cfg
    assert levels is not None
    cells = read_cells(layers, tiles)
    before = cells.ground
    found = sort_entries(cells, entries, robots.change.now.is_open.flatten()[place], levels.min_gap)
    cells = raise_ground(cells, layers, found.is_raised, levels.min_gap, rate, cfg)
    own, aside = ((found.is_aside == other).nonzero()[:, 0] for other in (False, True))
    of_ground = entries.select(own, torch.arange(layers.shape[1], device=own.device))
    is_contradicted = fuse_entries(layers, of_ground, rate, cfg)
    cells = cells._replace(ground=layers[_GROUND[0]].clone())
    others = robot[aside], entries.cell[aside], place[aside]
    cells = fuse_surfaces(cells, robots, pieces, others, levels, rate, cfg)
    write_surfaces(cells, layers, tiles)
    write_space(layers, before, found.is_open, tiles, robots, pieces)
    return robot[own][is_contradicted]


def read_cells(layers: Float[Tensor, "L C"], tiles: Tiles) -> Cells:
    """Return copies of the surfaces of tiles' cells."""
    rows = {name: layers[_rows(tiles, name)].nan_to_num(nan=0.0)[None] for name in SURFACE}
    top, is_open = (layers[tiles.layers.index(name)][None] for name in SPACE)
    return Cells(Levels(**rows, free_top=top, is_open=is_open == 1), layers[_GROUND[0]].clone())


def _rows(tiles: Tiles, name: str) -> list[int]:
    return [tiles.layers.index(f"surface{place}/{name}") for place in range(tiles.levels.others)]


class Sorted(NamedTuple):
    """Which heights of windows measure the ground of a site's cells."""

    is_aside: Bool[Tensor, "K"]  #: entries that measure another surface
    is_raised: Bool[Tensor, "C"]  #: cells whose ground is no longer the lowest surface
    is_open: Bool[Tensor, "C"]  #: the space above the lowest surface is known to be free


def sort_entries(cells: Cells, entries: Entries, is_open: Bool[Tensor, "K"], min_gap: float) -> Sorted:
    """Return which heights measure the ground: the lowest surface of a cell.

    A height more than `min_gap` above the lowest one is another surface if the space between is known to be free, by
    the robot that saw the lower one, or by the site. Otherwise both are the ground, and contradict each other. A height
    next to another surface of the site, and not below it, measures that.

    Args:
        cells: of the site.
        entries: heights that are the lowest surfaces of their robots.
        is_open: the robots know that the space above them is free.
        min_gap: [m].
    """
    height, cell = entries.heights.elevation, entries.cell
    ground = cells.ground.nan_to_num(nan=torch.inf)
    lowest = ground.scatter_reduce(0, cell, height, "amin")
    shows = (is_open & (height <= lowest[cell] + min_gap)).to(height.dtype)
    space = (cells.surfaces.is_open[0] & (ground <= lowest + min_gap)).to(height.dtype)
    space = space.scatter_reduce(0, cell, shows, "amax") > 0
    here = cells.at(cell)
    away, place = here.nearest(height, height)
    lower = here.surfaces.lower[0].gather(0, place[None])[0]
    is_other = (away <= min_gap) & (height >= lower) & (away < (height - here.ground).abs().nan_to_num(nan=torch.inf))
    is_aside = is_other | (space[cell] & (height > lowest[cell] + min_gap))
    is_raised = space & (cells.ground > lowest + min_gap)
    return Sorted(is_aside, is_raised, space)


def raise_ground(
    cells: Cells,
    layers: Float[Tensor, "L C"],
    is_raised: Bool[Tensor, "C"],
    min_gap: float,
    rate: float,
    cfg: SiteConfig,
) -> Cells:
    """Turn the ground of some cells into one of their other surfaces, in place; return the cells without it."""
    cell = is_raised.nonzero()[:, 0]
    elevation, variance, time = (layers[row][cell] for row in _GROUND)
    nothing = Heights(*[torch.full_like(time, torch.nan)] * 3)
    ground = torch.where(is_raised, torch.nan, cells.ground)
    support = torch.full_like(time, SETTLED)
    raised = Surfaces(cell, elevation, elevation, variance, support, time, nothing, nothing)
    join(cells._replace(ground=ground), raised, min_gap, rate, cfg)
    for row in (*_GROUND, *_OTHER):
        layers[row][cell] = torch.nan
    return cells._replace(ground=ground)


def fuse_surfaces(
    cells: Cells,
    robots: Robots,
    pieces: Pieces,
    aside: tuple[Tensor, Tensor, Tensor],
    levels: LevelsConfig,
    rate: float,
    cfg: SiteConfig,
) -> Cells:
    """Return cells with the robots' surfaces above the ground; `aside`: robots, cells, places of their lowest ones."""
    change, others = robots.change, range(1, robots.change.now.upper.shape[1])
    for level in range(len(others) + 1) if change.gone is not None else ():
        withdraw(cells, _read_gone(robots, pieces, level), levels.min_gap)
    parts = [_read(robots, aside, 0), *(_read(robots, pieces.select(change.is_new[:, k]), k) for k in others)]
    for part in parts:
        join(cells, part, levels.min_gap, rate, cfg)
    return tidy(cells, levels.min_gap)


def _read(robots: Robots, chosen: tuple[Tensor, Tensor, Tensor], level: int) -> Surfaces:
    """Return the surfaces in one place of windows, for robots, cells of the site and places of the flat windows."""
    (robot, cell, place), change = chosen, robots.change
    lower, upper = robots.faces(change.now, (robot, place), level, False)
    support = change.now.support[:, level].flatten()[place]
    below = above = Heights(*[torch.full_like(lower.time, torch.nan)] * 3)
    if change.before is not None:
        counts = change.before.is_known[:, level].flatten()[place]
        earlier = robots.faces(change.before, (robot, place), level, True)
        below, above = (h._replace(time=torch.where(counts, h.time, torch.nan)) for h in earlier)
    return Surfaces(cell, lower.elevation, upper.elevation, upper.variance, support, upper.time, below, above)


def _read_gone(robots: Robots, pieces: Pieces, level: int) -> Surfaces:
    """Return the surfaces in one place of windows that robots have cleared since their last merge."""
    gone = robots.change.gone
    assert gone is not None
    robot, cell, place = pieces.select(gone.is_known[:, level])
    lower, upper = robots.faces(gone, (robot, place), level, True)
    support = gone.support[:, level].flatten()[place]
    return Surfaces(cell, lower.elevation, upper.elevation, upper.variance, support, upper.time, lower, upper)


def write_surfaces(cells: Cells, layers: Float[Tensor, "L C"], tiles: Tiles) -> None:
    """Write surfaces into the layers of tiles."""
    is_there = cells.surfaces.support[0] > 0
    for name in SURFACE:
        layers[_rows(tiles, name)] = torch.where(is_there, getattr(cells.surfaces, name)[0], torch.nan)


def write_space(
    layers: Float[Tensor, "L C"],
    before: Float[Tensor, "C"],
    is_open: Bool[Tensor, "C"],
    tiles: Tiles,
    robots: Robots,
    pieces: Pieces,
) -> None:
    """Write what the site and robots know of the space above the ground, in place.

    Free space counts from the ground that it was seen above: where the site's ground has become another one, the site
    forgets it, and robots whose ground is another one add nothing.

    Args:
        layers: of the tiles, with the ground after the merge.
        before: the ground before the merge [m], NaN where unknown.
        is_open: cells in which the space above the ground is known to be free for at least the least gap.
        tiles: of the site.
        robots: what they know.
        pieces: of the windows.
    """
    (row, opened), gap = (tiles.layers.index(name) for name in SPACE), tiles.levels.max_difference
    ground, stack = layers[_GROUND[0]], robots.change.now
    robot, cell, place = pieces.select(stack.free_top > -torch.inf)
    above = rise(robots.windows.known, robots.alignment, robot, place, robots.resolution)
    own = torch.where(stack.is_known[:, 0], stack.upper[:, 0], torch.nan).flatten()[place] - above
    top = stack.free_top.flatten()[place] - above
    top = torch.where(_is_same_ground(own, ground[cell], gap), top, -torch.inf)
    kept = torch.where(_is_same_ground(before, ground, gap), layers[row].nan_to_num(nan=-torch.inf), -torch.inf)
    highest = kept.scatter_reduce(0, cell, top, "amax")
    layers[row] = torch.where(highest > -torch.inf, highest, torch.nan)
    layers[opened] = torch.where(is_open & ~ground.isnan(), 1.0, torch.nan)


def _is_same_ground(one: Tensor, other: Tensor, min_gap: float) -> Bool[Tensor, "..."]:
    """Return where heights [m] are within `min_gap`, or both unknown: NaN."""
    return ((one - other).abs() <= min_gap) | (one.isnan() & other.isnan())
