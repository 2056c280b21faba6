"""One merge: the windows of B robots, in the site's frame, into tiles."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.ops.parallel import map_in_order
from torchelev.site.content.tiles import LAYERS, Tile, Tiles
from torchelev.site.fusion.entries import fuse_entries, read_offers, rise
from torchelev.site.fusion.fuse_levels import Robots, fuse_levels
from torchelev.site.fusion.fuse_shares import fuse_channels
from torchelev.site.fusion.pieces import Group, group_tiles
from torchelev.site.fusion.shares import Change
from torchelev.site.fusion.stacks import Change as SurfaceChange
from torchelev.site.fusion.windows import Alignment, Windows
from torchelev.site.site_config import SiteConfig

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_ELEVATION, _BOUND, _TIME = (LAYERS.index(name) for name in ("elevation", "upper_bound", "time"))


class MergeReport(NamedTuple):
    """The result of a merge, per robot."""

    offsets: Float[Tensor, "B"]  #: [m] how much the robot's heights lie above the site's; subtracted before fusing
    tilts: Float[Tensor, "B 2"]  #: rise over run along x and y; subtracted, too
    is_isolated: Bool[Tensor, "B"]  #: overlaps nothing on flat, certain ground: it keeps its last offset, or 0
    new_cells: Int[Tensor, "B"]  #: measured since its last merge
    contradictions: Int[Tensor, "B"]  #: of these, cells whose height contradicts another one: kept apart


class Merged(NamedTuple):
    """Tiles after a merge."""

    tiles: list[Tile]  #: that the windows touch
    values: Float[Tensor, "L n T T"]  #: all layers of these tiles
    contradictions: Int[Tensor, "B"]  #: cells of each robot


def merge_windows(
    tiles: Tiles,
    windows: Windows,
    alignment: Alignment,
    resolution: float,
    rate: float,
    cfg: SiteConfig,
    changes: Mapping[str, Change] = MappingProxyType({}),
    surfaces: SurfaceChange | None = None,
) -> Iterator[Merged]:
    """Return the tiles that the windows touch after fusion, a group at a time; changes none in memory.

    Args:
        tiles: of the site.
        windows: of the robots.
        alignment: how they lie in the site's frame.
        resolution: [m].
        rate: [m^2/s] at which variances grow.
        cfg: settings.
        changes: of the channels that the robots know.
        surfaces: all that the robots know, of a site with levels: the ground of `windows` is the lowest one.
    """
    touched = windows.is_new | windows.is_bounded
    size = touched[0].numel()
    robots = None if surfaces is None else Robots(windows, surfaces, alignment, resolution)
    if surfaces is not None:
        touched = touched | surfaces.is_touched
    for change in changes.values():
        touched = touched | change.is_new
    groups = group_tiles(windows.known.corner, touched)
    can_rest = surfaces is None and not changes  # tiles whose bounds alone are seen again
    offers, has_bounds = read_offers(windows, alignment, resolution), bool(windows.is_bounded.any())
    tiles.reserve(sum(tile not in tiles for group in groups for tile in group.tiles))

    def fuse_group(group_and_values: tuple[Group, Tensor]) -> Merged:
        group, values = group_and_values
        pieces, layers = group.cut(), values.flatten(1)
        before = layers[_ELEVATION].clone() if tiles.channels else layers[_ELEVATION]
        cell, place = pieces.find(windows.is_new)
        entries = offers.at(cell, place)
        if robots is None:
            robot = place[fuse_entries(layers, entries, rate, cfg)] // size
        else:
            robot = fuse_levels(layers, entries, place // size, place, tiles, robots, pieces, rate, cfg)
        bound = layers[_BOUND].clone() if has_bounds and not len(cell) else None
        if has_bounds:
            bounded, its_place = pieces.find(windows.is_bounded)
            lower_bounds(layers, bounded, read_bounds(windows, alignment, its_place, resolution))
        fuse_channels(layers, before, layers[_ELEVATION], tiles, pieces, changes)
        contradictions = torch.bincount(robot, minlength=len(alignment.offset))
        is_same = bound is not None and can_rest and torch.equal(_known(bound), _known(layers[_BOUND]))
        return Merged([], values[:, :0], contradictions) if is_same else Merged(pieces.tiles, values, contradictions)

    work = ((group, tiles.read(group.tiles)) for group in groups)
    return map_in_order(fuse_group, work) if tiles.device.type == "cpu" else map(fuse_group, work)


def _known(bounds: Tensor) -> Tensor:
    """Return bounds, infinite where there are none, so that these are equal to each other."""
    return bounds.nan_to_num(nan=torch.inf)


def read_bounds(
    windows: Windows, alignment: Alignment, place: Int[Tensor, "u"], resolution: float
) -> Float[Tensor, "u"]:
    """Return upper bounds at places of the flat windows [m], in the site's frame."""
    above = rise(windows.known, alignment, place // windows.is_new[0].numel(), place, resolution)
    return (windows.upper_bound.view(-1).index_select(0, place) - above).float()


def lower_bounds(layers: Float[Tensor, "L C"], cell: Int[Tensor, "U"], heights: Float[Tensor, "U"]) -> None:
    """Lower the upper bounds of unknown cells to these heights, in place."""
    if not len(cell):
        return
    bound = _known(layers[_BOUND]).scatter_reduce(0, cell, heights.to(layers.dtype), "amin")
    layers[_BOUND] = torch.where((layers[_TIME] == layers[_TIME]) | (bound == torch.inf), torch.nan, bound)
