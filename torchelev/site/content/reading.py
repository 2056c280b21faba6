"""Reading a site: areas, and samples at points. Variances and ages are those at the site's time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.layers import lowest_counting, surrounding_cells, weighted_mean
from torchelev.levels import LAYERS as LEVEL_LAYERS
from torchelev.site.content.tiles import LAYERS as STORED
from torchelev.site.content.tiles import TILE, Tiles, locate

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

LAYERS = (*STORED, "validity")
_FARTHEST = 2.0**40  # cells
_SOURCES = {  # sources of a layer, first the one that is known where the layer is
    "elevation": ("elevation",),
    "variance": ("variance", "time"),
    "time": ("time",),
    "upper_bound": ("upper_bound", "elevation"),
    "other_elevation": ("other_elevation",),
    "other_variance": ("other_variance", "other_time"),
    "other_time": ("other_time",),
    "validity": ("time",),
}


class Clock(NamedTuple):
    """The time and rate by which layers age."""

    time: float  #: [s] the site's, from its epoch
    rate: float  #: [m^2/s] at which variances grow


def all_layers(tiles: Tiles) -> tuple[str, ...]:
    """Return the names of all layers of a site."""
    return (*LAYERS, *tiles.levels.layers, *tiles.channels.layers)


def check_layers(layers: Sequence[str] | None, tiles: Tiles) -> tuple[str, ...]:
    """Return names of layers; None: all. TypeError if they are not a list, KeyError if one does not exist."""
    is_list, hint = not isinstance(layers, str), f"give [{layers!r}]"
    require(is_list, "layers", "must be a list of names", repr(layers), hint, TypeError)
    if layers is None:
        return all_layers(tiles)
    configs = tiles.channels.configs
    parts = [part for name in layers for part in (configs[name].components(name) if name in configs else (name,))]
    return tuple(check_layer("layers", name, tiles) for name in parts)


def check_layer(argument: str, name: str, tiles: Tiles) -> str:
    """Return the name of a layer; KeyError if it does not exist."""
    names = all_layers(tiles)
    hint = (
        "begin the site with levels=LevelsConfig()"
        if name in LEVEL_LAYERS and not tiles.levels
        else "check its spelling"
    )
    require(name in names, argument, f"must be one of {', '.join(names)}", repr(name), hint, KeyError)
    return name


def compute_layer(name: str, stored: dict[str, Tensor], clock: Clock, tiles: Tiles) -> Tensor:
    """Compute a layer from the stored ones, NaN where unknown."""
    if name in tiles.levels.layers:
        return tiles.levels.compute(name, stored, clock)
    if name in tiles.channels.layers:
        return tiles.channels.compute(name, stored)
    first, *others = (stored[source] for source in _SOURCES[name])
    if name.endswith("variance"):
        return first + clock.rate * (clock.time - others[0])
    if name.endswith("time"):
        return clock.time - first
    if name == "upper_bound":
        return torch.where(others[0].isnan(), first, others[0])
    return (~first.isnan()).to(first.dtype) if name == "validity" else first


def sources_of(names: Sequence[str], tiles: Tiles) -> list[str]:
    """Return the stored layers that these layers are computed from."""
    used = {source for name in names for source in _sources(name, tiles)}
    return [layer for layer in tiles.layers if layer in used]


def _sources(name: str, tiles: Tiles) -> tuple[str, ...]:
    if name in _SOURCES:
        return _SOURCES[name]
    if name in tiles.levels.layers:
        return tiles.levels.sources
    return tiles.channels.sources(tiles.channels.channel_of(name))


def read_area(
    tiles: Tiles, corner: tuple[int, int], size: tuple[int, int], names: Sequence[str], clock: Clock
) -> dict[str, Float[Tensor, "H W"]]:
    """Return layers of the cells from `corner` on, on the CPU; NaN where unknown."""
    sources = sources_of(names, tiles)
    rows = [tiles.layers.index(source) for source in sources]
    area = torch.full((len(sources), *size), torch.nan)
    for tile in _tiles_of(corner, size):
        if tile in tiles:
            start = [TILE * k - c for k, c in zip(tile, corner, strict=True)]
            to = tuple(slice(max(0, s), min(s + TILE, n)) for s, n in zip(start, size, strict=True))
            within = tuple(slice(t.start - s, t.stop - s) for t, s in zip(to, start, strict=True))
            area[:, to[0], to[1]] = tiles.read([tile])[rows, 0, within[0], within[1]].cpu()
    stored = dict(zip(sources, area, strict=True))
    return {name: compute_layer(name, stored, clock, tiles) for name in names}


def _tiles_of(corner: tuple[int, int], size: tuple[int, int]) -> list[tuple[int, int]]:
    """Return the tiles that an area touches."""
    x, y = (range(c // TILE, (c + n - 1) // TILE + 1) for c, n in zip(corner, size, strict=True))
    return [(a, b) for a in x for b in y]


def sample_tiles(
    tiles: Tiles, cells: Float[Tensor, "M 2"], name: str, mode: str, clock: Clock
) -> tuple[Float[Tensor, "M"], Bool[Tensor, "M"]]:
    """Sample a layer at points, as `ElevationMap.sample` does.

    Args:
        tiles: of the site.
        cells: points, float64, in cells of the lattice.
        name: of the layer.
        mode: "bilinear" or "nearest".
        clock: of the site.

    Returns:
        Values, 0 where not valid, and the mask of where they are.
    """
    finite = (cells.abs() < _FARTHEST).all(1)  # NaN is not
    i, j, weight = surrounding_cells(torch.where(finite[:, None], cells, 0.0)[None], mode)
    sources = sources_of([name], tiles)
    looked_up = tiles.look_up(locate(i.flatten().long(), j.flatten().long()), sources)
    stored = dict(zip(sources, looked_up, strict=True))
    values = compute_layer(name, stored, clock, tiles).view(weight.shape)
    weight = torch.where(values.isnan() | ~finite, 0.0, weight)
    counts = weight > 0
    if name in LEVEL_LAYERS:
        found, valid = lowest_counting(values, counts, weight)
    else:
        found, valid = weighted_mean(torch.where(counts, values, 0.0), weight)  # 0 times NaN is NaN
    return found[0].float(), valid[0]
