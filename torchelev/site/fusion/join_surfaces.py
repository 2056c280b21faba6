"""Joining the surfaces of robots with those of a site's cells: the rules of `torchelev.levels.surfaces`."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.levels.state import SURFACE, Levels
from torchelev.levels.surfaces import Found, distance, insert, merge
from torchelev.site.fusion.fuse import Heights

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jaxtyping import Bool, Float, Int

    from torchelev.site.site_config import SiteConfig

_SAME_TIME = 0.01  # [s] more than rounding


_OWN = ("cell", "lower", "upper", "variance", "support", "time")


class Surfaces(NamedTuple):
    """N surfaces in the site's frame. Variances are those right after the last measurement."""

    cell: Int[Tensor, "N"]  #: number of the cell
    lower: Float[Tensor, "N"]  #: [m]
    upper: Float[Tensor, "N"]  #: [m]
    variance: Float[Tensor, "N"]  #: [m^2]
    support: Float[Tensor, "N"]  #: points
    time: Float[Tensor, "N"]  #: [s] of the last measurement
    below: Heights  #: lower faces of what the same robots contributed before, which these replace; time NaN: nothing
    above: Heights  #: upper faces of the same

    def at(self, chosen: Tensor) -> Surfaces:
        """Return the ones with these numbers."""
        below, above = self.below.at(chosen), self.above.at(chosen)
        own = {name: getattr(self, name)[chosen] for name in _OWN}
        return self._replace(below=below, above=above, **own)


class Cells(NamedTuple):
    """C cells of a site: their surfaces besides the ground, L places with a support of 0 where empty."""

    surfaces: Levels  #: (1, L, C), with the time of the last measurement [s] on the site's clock
    ground: Float[Tensor, "C"]  #: [m] NaN where unknown

    def at(self, cells: Int[Tensor, "N"]) -> Cells:
        """Return some cells."""
        return Cells(Levels(*(value[..., cells] for value in self.surfaces)), self.ground[cells])

    def put(self, cells: Int[Tensor, "N"], surfaces: Levels) -> None:
        """Replace the surfaces of some cells, in place."""
        for name in SURFACE:
            getattr(self.surfaces, name)[..., cells] = getattr(surfaces, name)

    def nearest(self, lower: Tensor, upper: Tensor) -> tuple[Float[Tensor, "C"], Int[Tensor, "C"]]:
        """Return the distance [m] of the surface next to an interval in each cell, inf without one, and its place."""
        s = self.surfaces
        away = torch.where(s.support > 0, distance(lower, upper, s.lower, s.upper), torch.inf)
        return away[0].min(0)

    def mask_of(self, place: Int[Tensor, "C"], counts: Bool[Tensor, "C"]) -> Bool[Tensor, "1 L C"]:
        """Return the mask of one place in each of the cells that count."""
        return torch.zeros_like(self.surfaces.support, dtype=torch.bool).scatter(
            1, place[None, None], counts[None, None]
        )


def join(cells: Cells, new: Surfaces, min_gap: float, rate: float, cfg: SiteConfig) -> None:
    """Join surfaces with cells, in place.

    Within `min_gap` [m] of a surface that a cell has, a new one is another measurement of it. One that is nearer to the
    ground is the ground's. Others take an empty place, or that of the surface of the fewest points, if they have more.
    """
    for part in _rounds(new):
        here = cells.at(part.cell)
        away, place = here.nearest(part.lower, part.upper)
        to_ground = distance(part.lower, part.upper, here.ground, here.ground).nan_to_num(nan=torch.inf)
        joins = (away <= min_gap) & (away <= to_ground)
        fused = _fuse(here.surfaces, place, part, rate, cfg)
        chosen = here.mask_of(place, joins)
        surfaces = here.surfaces._replace(
            **{n: torch.where(chosen, fused[n], getattr(here.surfaces, n)) for n in SURFACE}
        )
        is_other = (~joins & (to_ground > min_gap))[None]
        surfaces, _ = insert(surfaces, is_other, _found(part), part.time)
        cells.put(part.cell, surfaces)


def _found(new: Surfaces) -> Found:
    """Return surfaces as a scan shows them, whose faces are as they are."""
    lower, upper, variance, support = (value[None] for value in (new.lower, new.upper, new.variance, new.support))
    return Found(lower, upper, upper, variance, torch.zeros_like(upper), support)


def _rounds(new: Surfaces) -> Iterator[Surfaces]:
    """Yield surfaces so that each time none share a cell."""
    if not len(new.cell):
        return
    cell, order = new.cell.sort(stable=True)
    number = torch.arange(len(cell), device=cell.device)
    begins = torch.cat([cell.new_ones(1, dtype=torch.bool), cell[1:] != cell[:-1]])
    rank = number - torch.where(begins, number, 0).cummax(0).values
    for k in range(int(rank.max()) + 1):
        yield new.at(order[rank == k])


def _fuse(old: Levels, place: Int[Tensor, "N"], new: Surfaces, rate: float, cfg: SiteConfig) -> dict[str, Tensor]:
    """Return the surfaces after another measurement of the ones in these places.

    A face within the gate of the measured one is averaged with it by the information form of `fuse`, in which the
    robot's earlier contribution is replaced. A face beyond makes the surface thicker, as sure as the less sure one, and
    one between changes nothing.
    """
    lower, upper, variance, support, time = (getattr(old, name)[0].gather(0, place[None])[0] for name in SURFACE)
    newest = torch.maximum(time, new.time)
    own, given = (1 / (v + rate * (newest - t)) for v, t in ((variance, time), (new.variance, new.time)))
    limit = cfg.gate**2 * (1 / own + 1 / given).clamp(max=cfg.max_gate_std**2)
    faces, information = [], torch.minimum(own, given)
    for face, seen, before in ((lower, new.lower, new.below), (upper, new.upper, new.above)):
        agrees = (seen - face).square() <= limit
        holds = agrees & ((before.elevation - face).square() <= (cfg.gate * cfg.max_gate_std) ** 2)  # NaN is not
        counted = before.information(newest, rate)
        height = torch.where(counted >= given, seen, before.elevation)
        counted = torch.where(holds, torch.minimum(counted, given), 0.0)
        total = own + given - counted
        moment = given * (seen - face) - torch.where(holds, counted * (height - face), 0.0)
        beyond = torch.maximum(face, seen) if face is upper else torch.minimum(face, seen)
        faces.append(torch.where(agrees, face + moment / total, beyond))
        information = torch.where(agrees, total, information)
    information = torch.where(_lies_within(lower, upper, new), torch.maximum(information, own), information)
    low, high = torch.minimum(*faces), torch.maximum(*faces)
    fused = (low, high, 1 / information, torch.maximum(support, new.support), newest)
    return {name: value.expand_as(getattr(old, name)) for name, value in zip(SURFACE, fused, strict=True)}


def _lies_within(lower: Tensor, upper: Tensor, new: Surfaces) -> Bool[Tensor, "N"]:
    """Return which measured surfaces lie within the known ones."""
    return (new.lower >= lower) & (new.upper <= upper)


def withdraw(cells: Cells, gone: Surfaces, min_gap: float) -> None:
    """Take out surfaces that their robots have cleared, in place, unless others have measured them since."""
    for part in _rounds(gone):
        here = cells.at(part.cell)
        away, place = here.nearest(part.lower, part.upper)
        time = here.surfaces.time[0].gather(0, place[None])[0]
        goes = (away <= min_gap) & (time <= part.time + _SAME_TIME)
        cells.put(part.cell, _without(here.surfaces, here.mask_of(place, goes)))


def tidy(cells: Cells, min_gap: float) -> Cells:
    """Return cells whose surfaces that meet are one, without those that meet the ground."""
    surfaces, _ = merge(cells.surfaces)
    ground = cells.ground.nan_to_num(nan=torch.inf)
    is_ground = distance(surfaces.lower, surfaces.upper, ground, ground) < 0.5 * min_gap
    return Cells(_without(surfaces, is_ground), cells.ground)


def _without(surfaces: Levels, gone: Bool[Tensor, "1 L C"]) -> Levels:
    return surfaces._replace(support=torch.where(gone, 0.0, surfaces.support))
