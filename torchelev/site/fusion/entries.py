"""The heights that windows have for cells, in the site's frame, and their fusion into tiles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.site.fusion.fuse import Entries, Heights, fuse
from torchelev.site.fusion.windows import Alignment, Contribution, Known, Windows
from torchelev.site.site_config import SiteConfig

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_WITHIN_CELL = 1 / 12  # variance of a position that is uniform in a cell of size 1
_STEEPEST = 1.0  # slope taken where the known neighbours of a cell span no plane
MIN_VARIANCE = 1e-10  # [m^2]


def read_entries(
    windows: Windows, alignment: Alignment, robot: Tensor, cell: Tensor, place: Tensor, resolution: float
) -> Entries:
    """Return the heights at places of the flat windows.

    Args:
        windows: B windows.
        alignment: how they lie in the site's frame.
        robot: (K,) robots.
        cell: (K,) numbers of the site's cells.
        place: (K,) numbers of the windows' cells.
        resolution: [m].
    """
    heights = read_heights(windows.known, alignment, robot, place, resolution)
    slope = (
        windows.gradient_x.view(-1).index_select(0, place).square()
        + windows.gradient_y.view(-1).index_select(0, place).square()
    )
    slope = torch.where(windows.has_normal.view(-1).index_select(0, place), slope, _STEEPEST**2)
    contribution = (
        None
        if windows.contribution is None
        else _read_contribution(windows, windows.contribution, robot, place, resolution)
    )
    return Entries(cell, heights, slope.float() * (resolution**2 * _WITHIN_CELL), contribution)


def rise(known: Known, alignment: Alignment, robot: Tensor, place: Tensor, resolution: float) -> Tensor:
    """Return how much a window's heights lie above the site's at its cells, (K,) float32 [m]."""
    shift = alignment.offset.float().index_select(0, robot)
    if alignment.tilt.any():
        H, W = known.elevation.shape[1:]
        cell = torch.stack([place // W % H + 0.5 - H / 2, place % W + 0.5 - W / 2], 1)
        shift = shift + (alignment.tilt.index_select(0, robot) * cell * resolution).sum(1).float()
    return shift


def read_heights(known: Known, alignment: Alignment, robot: Tensor, place: Tensor, resolution: float) -> Heights:
    """Return a window's heights in the site's frame, (K,) each."""
    elevation, variance, age = (layer.view(-1).index_select(0, place).float() for layer in known[1:4])
    elevation = elevation - rise(known, alignment, robot, place, resolution)
    variance = (variance - known.rate.float().index_select(0, robot) * age).clamp(min=MIN_VARIANCE)
    return Heights(elevation, variance, (known.now.index_select(0, robot) - age).float())


def _read_contribution(
    windows: Windows, contribution: Contribution, robot: Tensor, place: Tensor, resolution: float
) -> Heights:
    """Return the earlier contributions of the same robots, NaN where there are none."""
    H, W = windows.known.elevation.shape[1:]
    shift = (windows.known.corner - contribution.known.corner)[robot]
    i, j = place // W % H + shift[:, 0], place % W + shift[:, 1]
    inside = (i >= 0) & (i < H) & (j >= 0) & (j < W)
    place = (robot * H + i.clamp(0, H - 1)) * W + j.clamp(0, W - 1)
    elevation, variance, time = read_heights(contribution.known, contribution.alignment, robot, place, resolution)
    counts = inside & contribution.known.is_known.view(-1).index_select(0, place)
    return Heights(elevation, variance, torch.where(counts, time, torch.nan))


def fuse_entries(layers: Float[Tensor, "L C"], entries: Entries, rate: float, cfg: SiteConfig) -> Bool[Tensor, "K"]:
    """Fuse entries into the layers of tiles, in place; return which contradict other heights of their cells."""
    fused = fuse(Heights(*layers[0:3]), Heights(*layers[4:7]), entries, rate, cfg)
    for row, value in zip((0, 1, 2, 4, 5, 6), (*fused.first, *fused.other), strict=True):
        layers[row] = value
    return fused.is_contradicted
