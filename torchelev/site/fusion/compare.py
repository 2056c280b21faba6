"""Heights of the same cell in two windows, or in a window and the site, from which the offsets follow."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.site.content.tiles import TILE, locate_tiles
from torchelev.site.fusion.exchange import ALONE, Exchange
from torchelev.site.fusion.windows import Windows
from torchelev.site.site_config import SiteConfig

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_NEIGHBORS = 8  # windows of a cell that each window is compared with; it reaches the others through these
_MAX_PAIRS = 1 << 17
_BYTES = 16  # of a cell that is sent to the owner of its tile

ReadSite = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]  # cell numbers x, y (K,) -> elevation, variance (K,)


class Robots(NamedTuple):
    """What all ranks know of all N windows."""

    corner: Int[Tensor, "N 2"]  #: cell numbers of [..., 0, 0] on the lattice
    before: Float[Tensor, "N"]  #: [m] offsets of the last merge, NaN of windows that have not contributed yet
    first: int  #: number of this rank's first window


class Compared(NamedTuple):
    """Heights of flat and certain cells."""

    window: Int[Tensor, "K"]  #: of all ranks
    place: Int[Tensor, "K"]  #: number of the cell in the window
    height: Float[Tensor, "K"]  #: [m]
    variance: Float[Tensor, "K"]  #: [m^2]

    def select(self, chosen: Int[Tensor, "k"]) -> Compared:
        """Return the ones with these numbers."""
        return Compared(*(value.index_select(0, chosen) for value in self))


class Pairs(NamedTuple):
    """Heights of the same cell in two windows, or in a window and the site."""

    first: Int[Tensor, "P"]  #: window
    second: Int[Tensor, "P"]  #: window; N: the site
    difference: Float[Tensor, "P"]  #: [m] first - second, float64
    variance: Float[Tensor, "P"]  #: [m^2] of the difference, float64
    position: Float[Tensor, "4 P"] | None  #: [m] x and y of the cell from the centre of both windows; None: not needed

    def select(self, chosen: Int[Tensor, "p"]) -> Pairs:
        """Return the ones with these numbers."""
        position = None if self.position is None else self.position.index_select(1, chosen)
        first, second, difference, variance = (value.index_select(0, chosen) for value in self[:4])
        return Pairs(first, second, difference, variance, position)


def gather_robots(windows: Windows, exchange: Exchange) -> Robots:
    """Return what alignment needs of the windows of all ranks."""
    before = _known_offsets(windows)
    rows = exchange.gather(lambda: torch.cat([windows.known.corner, before.view(torch.int64)[:, None]], 1))
    every = torch.cat(rows)
    return Robots(every[:, :2], every[:, 2].contiguous().view(torch.float64), sum(map(len, rows[: exchange.rank])))


def _known_offsets(windows: Windows) -> Float[Tensor, "B"]:
    contribution = windows.contribution
    if contribution is None:
        return torch.full(windows.known.now.shape, torch.nan, dtype=torch.float64, device=windows.known.now.device)
    return torch.where(contribution.known.is_known.flatten(1).any(1), contribution.alignment.offset, torch.nan)


def find_pairs(
    windows: Windows,
    robots: Robots,
    read_site: ReadSite,
    resolution: float,
    cfg: SiteConfig,
    with_position: bool,
    max_difference: float = math.inf,
    exchange: Exchange = ALONE,
) -> Callable[[], Pairs]:
    """Return a function that finds the pairs of heights of this rank's tiles, of cells that are flat and certain.

    The cells that are compared are dealt to the owners of their tiles. Other arguments as of `align.align`.
    """
    compared = choose_compared(windows, robots, cfg)
    size = windows.known.elevation.shape[1:]
    total = len(compared.window)
    if exchange.size > 1:
        compared, total = _deal(compared, robots, size, exchange)

    def find() -> Pairs:
        pairs = _find_pairs(compared, robots, size, read_site, resolution if with_position else None, total)
        if max_difference == math.inf:
            return pairs
        before = robots.before.nan_to_num(nan=0.0)
        offset = torch.cat([before, before.new_zeros(1)])
        same = (pairs.difference - (offset[pairs.first] - offset[pairs.second])).abs() <= max_difference
        return pairs.select(same.nonzero()[:, 0])

    return find


def choose_compared(windows: Windows, robots: Robots, cfg: SiteConfig) -> Compared:
    """Return the heights of this rank's windows to compare: of flat and certain cells, thinned on the lattice."""
    known, corner = windows.known, windows.known.corner
    (B, H, W), N = known.elevation.shape, len(robots.corner)
    stride = math.ceil(math.sqrt(N * H * W / cfg.max_compared))
    # Of many windows, each keeps enough cells that overlaps are found.
    stride = max(1, min(stride, math.isqrt(H * W // (16 * cfg.min_overlap))))
    i, j = (
        (-corner[:, axis, None]) % stride + stride * torch.arange(-(-size // stride), device=corner.device)
        for axis, size in enumerate((H, W))
    )
    inside = (i < H)[:, :, None] & (j < W)[:, None]
    window = torch.arange(B, device=corner.device)[:, None, None]
    place = ((window * H + i[:, :, None]) * W + j[:, None]).view(-1)
    is_good = windows.has_normal & known.is_known
    if not inside.all():
        place = place.index_select(0, inside.view(-1).nonzero()[:, 0])
    place = place.index_select(0, is_good.view(-1).index_select(0, place).nonzero()[:, 0])
    gradient_x, gradient_y, variance = (
        layer.reshape(-1).index_select(0, place) for layer in (windows.gradient_x, windows.gradient_y, known.variance)
    )
    is_flat = gradient_x.square() + gradient_y.square() <= cfg.max_slope**2
    good = (is_flat & (variance <= cfg.max_std**2)).nonzero()[:, 0]
    place = place.index_select(0, good)
    window = place // (H * W)
    height = known.elevation.reshape(-1).index_select(0, place)
    return Compared(
        window + robots.first, place - window * (H * W), height.float(), variance.index_select(0, good).float()
    )


def _lattice(compared: Compared, robots: Robots, size: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Return the cell numbers x and y of cells of windows."""
    W, corner = size[1], robots.corner.index_select(0, compared.window)
    i = compared.place // W
    return corner[:, 0] + i, corner[:, 1] + (compared.place - i * W)


def _deal(compared: Compared, robots: Robots, size: tuple[int, ...], exchange: Exchange) -> tuple[Compared, int]:
    """Send cells to the owners of their tiles; return those of this rank, by windows, and how many all are."""

    def send() -> tuple[Tensor, list[int]]:
        x, y = _lattice(compared, robots, size)
        tiles, number = locate_tiles(x // TILE, y // TILE)
        own = torch.tensor(tiles, dtype=torch.int64, device=x.device).view(-1, 2)
        owner = exchange.find_owners(*own.unbind(1)).index_select(0, number)
        chosen = [(owner == rank).nonzero()[:, 0] for rank in range(exchange.size)]
        parts = [torch.stack([*map(_as_int32, compared.select(its))]).view(-1) for its in chosen]
        return torch.cat(parts).view(torch.uint8), [_BYTES * len(its) for its in chosen]

    received, num_bytes = exchange.deal(send)
    values = torch.cat([row.view(torch.int32).view(4, -1) for row in received], 1)
    heights = (value.view(torch.float32) for value in values[2:])
    return Compared(values[0].long(), values[1].long(), *heights), num_bytes // _BYTES


def _as_int32(values: Tensor) -> Tensor:
    return values.view(torch.int32) if values.dtype == torch.float32 else values.to(torch.int32)


def _find_pairs(
    compared: Compared,
    robots: Robots,
    size: tuple[int, ...],
    read_site: ReadSite,
    resolution: float | None,
    total: int,
) -> Pairs:
    """Return all pairs of cells, with their positions if there is a resolution; `total`: cells of all ranks."""
    window, height, variance = compared.window, compared.height, compared.variance
    x, y = _lattice(compared, robots, size)
    site_height, site_variance = read_site(x, y)
    known = site_height.isfinite().nonzero()[:, 0]
    difference = (height - site_height).index_select(0, known)
    site = torch.full_like(known, len(robots.corner))
    found = [(known, known, window.index_select(0, known), site, difference, (variance + site_variance)[known])]
    order, cell = _sort_by_cell(x, y)
    ordered = [value.index_select(0, order) for value in (window, height, variance)]
    for apart in range(1, min(_NEIGHBORS, len(robots.corner) - 1) + 1):
        a = (cell[apart:] == cell[:-apart]).nonzero()[:, 0]
        if not len(a):
            break
        w, h, v = ([value.index_select(0, k) for k in (a, a + apart)] for value in ordered)
        found.append((order[a], order[a + apart], w[0], w[1], h[0] - h[1], v[0] + v[1]))
        if apart * total > _MAX_PAIRS:
            break
    a, b, first, second, differences, total_variance = (torch.cat(column) for column in zip(*found, strict=True))
    position = None
    if resolution is not None:
        half = torch.tensor(size, device=x.device) / 2 - 0.5
        place = torch.stack([x, y]) - robots.corner[window].T - half[:, None]
        position = torch.cat([place[:, a], place[:, b]]) * resolution
    return Pairs(first, second, differences.double(), total_variance.double(), position)


def _sort_by_cell(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return the order of cells in which equal ones are neighbours, in their own order, and their numbers in it."""
    if not len(x):
        return x, x
    number = (x - x.min()) * (int(y.max() - y.min()) + 1) + (y - y.min())
    cell, order = torch.sort(number, stable=True)
    return order, cell
