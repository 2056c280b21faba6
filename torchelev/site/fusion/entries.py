"""The heights that windows have for cells, in the site's frame, and their fusion into tiles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.site.fusion.fuse import Entries, Heights, fuse
from torchelev.site.fusion.windows import Alignment, Known, Windows
from torchelev.site.site_config import SiteConfig

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_WITHIN_CELL = 1 / 12  # variance of a position that is uniform in a cell of size 1
_ROBOTS = 16
_STEEPEST = 1.0  # slope taken where the known neighbours of a cell span no plane
MIN_VARIANCE = 1e-10  # [m^2]


class Offers(NamedTuple):
    """The heights of all cells of B windows, in the site's frame, flat; those that are not new do not count."""

    heights: Heights  #: (B * H * W,) each
    relief: Float[Tensor, "BHW"]  #: [m^2] variance of heights within the cell
    contributed: Heights | None  #: earlier contributions of the same robots; None: there are none

    def at(self, cell: Int[Tensor, "K"], place: Int[Tensor, "K"]) -> Entries:
        """Return the heights at places of the flat windows, for cells of the site."""
        contributed = None if self.contributed is None else self.contributed.at(place)
        return Entries(cell, self.heights.at(place), self.relief.index_select(0, place), contributed)


def read_offers(windows: Windows, alignment: Alignment, resolution: float) -> Offers:
    """Return the heights of windows in the site's frame.

    Args:
        windows: B windows.
        alignment: how they lie in the site's frame.
        resolution: [m].
    """
    contribution, before = windows.contribution, windows.before
    like = windows.is_new  # one by one: the system takes back what is larger than 32 MB
    layers = [torch.empty(like.shape, device=like.device) for _ in range(4 if before is None else 7)]
    if contribution is not None and before is not None:
        aligned = contribution.alignment.of_moved((before.corner - contribution.known.corner) * resolution)
    for start in range(0, len(like), _ROBOTS):  # some at a time, whose values stay in a CPU's caches
        part = slice(start, start + _ROBOTS)
        own = [layer[part] for layer in layers]
        _write_heights(own[:3], windows.known, alignment, part, resolution)
        slope = windows.gradient_x[part].square() + windows.gradient_y[part].square()
        slope = torch.where(windows.has_normal[part], slope, _STEEPEST**2)
        torch.mul(slope, resolution**2 * _WITHIN_CELL, out=own[3])
        if before is not None:
            _write_heights(own[4:], before, aligned, part, resolution)
            own[6].masked_fill_(~before.is_known[part], torch.nan)
    flat = [layer.view(-1) for layer in layers]
    return Offers(Heights(*flat[:3]), flat[3], None if before is None else Heights(*flat[4:]))


def _write_heights(
    layers: Sequence[Float[Tensor, "b H W"]], known: Known, alignment: Alignment, part: slice, resolution: float
) -> None:
    """Write elevations, variances and times of some windows, in the site's frame."""
    elevation, variance, time = layers
    shift, tilt = alignment.offset[part].float()[:, None, None], alignment.tilt[part]
    if tilt.any():
        axes = (resolution * (torch.arange(n, device=tilt.device) + 0.5 - n / 2) for n in elevation.shape[1:])
        x, y = (slope[:, None] * axis for slope, axis in zip(tilt.unbind(1), axes, strict=True))
        shift = shift + (x[:, :, None] + y[:, None]).float()
    torch.sub(known.elevation[part], shift, out=elevation)
    age = known.age[part]
    torch.addcmul(known.variance[part], known.rate[part].float()[:, None, None], age, value=-1, out=variance)
    variance.clamp_(min=MIN_VARIANCE)
    time.copy_(known.now[part, None, None] - age)


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


def fuse_entries(layers: Float[Tensor, "L C"], entries: Entries, rate: float, cfg: SiteConfig) -> Bool[Tensor, "K"]:
    """Fuse entries into the layers of tiles, in place; return which contradict other heights of their cells."""
    fused = fuse(Heights(*layers[0:3]), Heights(*layers[4:7]), entries, rate, cfg)
    for row, value in zip((0, 1, 2, 4, 5, 6), (*fused.first, *fused.other), strict=True):
        layers[row] = value
    return fused.is_contradicted
