"""Importing rasters into a site."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torchelev.errors import message, require
from torchelev.io.rasters.raster import VARIANCE, Raster
from torchelev.site.fusion.merge import Merged
from torchelev.site.rasters.merge_raster import Box, RasterCells, join, merge_raster
from torchelev.site.site_export import check_box
from torchelev.site.storage.interface import Note
from torchelev.site.times import check_time
from torchelev.site.versioned_site import VersionedSite

_ROUNDING = 1e-6  # of a cell


class RasterReport(NamedTuple):
    """The result of importing a raster."""

    cells: int  #: that the raster knows
    contradictions: int  #: of these, cells whose height contradicts another one: kept apart


class RasterSite(VersionedSite):
    """A site that takes rasters."""

    @property
    def rasters(self) -> list[dict[str, Any]]:
        """The rasters that were imported, oldest first.

        Each has its `name`, `time` [s] or None, `variance` [m^2], `cells` (the first x and y, and those past the last
        ones), and the `fingerprint` of its heights.
        """
        return [dict(raster) for raster in self._rasters]

    @property
    def _has_clock(self) -> bool:
        """Whether a merge, or a raster with a time, has set the epoch."""
        undated = sum(raster["time"] is None for raster in self._rasters)
        return len(self._tiles) > 0 and self._num_commits > undated

    @torch.inference_mode(False)  # whose tensors could not be written outside of it
    @torch.no_grad()
    def import_raster(
        self,
        raster: str | Path | Raster,
        *,
        band: int = 1,
        layer: str | None = None,
        variance: float = VARIANCE,
        epsg: int | None = None,
        origin: tuple[float, float] = (0.0, 0.0),
        height: float = 0.0,
        area: Sequence[float] | None = None,
        time: float | None = None,
    ) -> RasterReport:
        """Fuse a raster, such as a terrain model, as prior ground: one commit, of which all is stored or nothing.

        Its heights are fused as those of a robot are, by their variance, without an offset: what agrees is averaged,
        what contradicts a height is kept apart, and the newer one is shown once it is about as sure. So robots, which
        measure by centimetres, override a raster of the default variance. Imported first, it fixes the site's height:
        robots that come later are aligned with it. Later, its heights must be those of the site: give `height`.

        Pixels become cells by the rule of `torchelev.io.rasters.resample`. Memory does not grow with the raster, but
        does with what of it is known if the site is in memory.

        Args:
            raster: a path as of `Raster.open`, or a `Raster`, which has the next six settings itself.
            band: number of the band, from 1 on.
            layer: name of the band or layer, in place of `band`.
            variance: [m^2] of the heights at their time; it grows from then on as that of any cell.
            epsg: code of the projected coordinate system that the file must have; None: any one in metres, or none.
            origin: easting and northing [m] of the map frame's origin; x points east, y north.
            height: [m] of the map frame's origin in the raster's heights, which is subtracted.
            area: x_min, x_max, y_min, y_max [m], map frame, made larger to whole cells; None: all of the raster.
            time: [s] at which the raster was surveyed, on the clock of the merges. None: the oldest time of the site,
                that of its first merge, also if that is still to come.

        Returns:
            How many cells it knows, and how many contradict.

        Raises:
            FileNotFoundError: there is no such file.
            TypeError: `time` is not a number.
            ValueError: the raster cannot be read, is not in metres, knows nothing in the area, or was imported there
                before; an argument breaks its rule; or the site is read-only, closed, keeps keyframes or levels, or
                belongs to a group. Nothing has changed then.
            KeyError: there is no such layer.
            OSError: the disk is full; the site is as it was before.
            ModuleNotFoundError: a package is missing; the text says which extra installs it.
        """
        self._require_imports()
        time = check_time(time)
        settings = dict(band=band, layer=layer, variance=variance, epsg=epsg, origin=origin, height=height)
        opened = _open(raster, settings)
        box = self._find_box(opened, area)
        entry = {"name": opened.name, "time": time, "variance": opened.variance, "cells": [*box.first, *box.end]}
        entry["fingerprint"] = opened.fingerprint
        return self._in_turn(partial(self._import_once, opened, box, entry, time))

    def _import_once(self, raster: Raster, box: Box, entry: dict[str, Any], time: float | None) -> RasterReport:
        """Fuse a raster into the version that the site shows; Overtaken if it is no longer the newest one."""
        self._require_first(entry, box)
        before = self._epoch, self._time, self._rasters
        now = 0.0 if time is None else self._count_from_epoch(time)
        self._rasters = [*self._rasters, entry]
        try:
            return self._import(raster, box, now)
        except BaseException:
            self._epoch, self._time, self._rasters = before
            raise

    def _import(self, raster: Raster, box: Box, now: float) -> RasterReport:
        """Fuse a raster and write the tiles; `now` is its time from the epoch."""
        cells = RasterCells(raster, self.resolution, now, self._tiles.device)
        parts = _some(merge_raster(self._tiles, cells, box, self.resolution, self._clock.rate, self.cfg), raster.name)
        joined = join(parts) if self._store is None else parts
        contradictions = self._write(joined, max(self._time, now), 1, note=Note(f"raster {raster.name}"))
        return RasterReport(cells.known, int(contradictions.sum()))

    def _require_imports(self) -> None:
        """Raise ValueError unless the site can import rasters."""
        self._require_writable()
        rule, hint = "must be a site without keyframes, levels and group to import rasters", "import into another site"
        kept = {"keyframes": self._keyframes is not None, "levels": bool(self._tiles.levels)}
        kept["a group"] = self._ranks.size > 1
        actual = ", ".join(name for name, is_kept in kept.items() if is_kept)
        require(not actual, "site", rule, f"one with {actual}", hint)

    def _find_box(self, raster: Raster, area: Sequence[float] | None) -> Box:
        """Return the cells of a raster in an area, of which there must be some."""
        box = _to_cells(raster.extent, self.resolution)
        if area is not None:
            check_box(area)
            box = box.cut(_to_cells(area, self.resolution))
        extent = ", ".join(f"{value:g}" for value in raster.extent)
        hint = f"{raster.name} spans x_min, x_max, y_min, y_max = {extent} m of the map frame"
        require(not box.is_empty, "area", "must meet the raster", None if area is None else list(area), hint)
        return box

    def _require_first(self, entry: dict[str, Any], box: Box) -> None:
        """Raise ValueError if the same heights were imported into cells of this box before."""
        for earlier in self._rasters:
            x, y, x_end, y_end = earlier["cells"]
            is_same = earlier["fingerprint"] == entry["fingerprint"] and box.meets(Box((x, y), (x_end, y_end)))
            rule = "must not be imported twice, or its heights would count twice"
            hint = "leave it out; site.rasters lists what was imported"
            require(not is_same, "raster", rule, f"the heights of {earlier['name']} again", hint)

    def _count_from_epoch(self, time: float) -> float:
        """Return a time from the epoch; the first one that is given becomes it."""
        if not self._has_clock:
            self._epoch, self._time = time, 0.0
        return time - self._epoch


def _open(raster: str | Path | Raster, settings: dict[str, Any]) -> Raster:
    """Return a raster; ValueError if one that is open gets settings of another."""
    is_raster, hint = isinstance(raster, Raster), "give a path of a GeoTIFF, say"
    actual = type(raster).__name__
    require(
        is_raster or isinstance(raster, (str, Path)), "raster", "must be a path or a Raster", actual, hint, TypeError
    )
    if not isinstance(raster, Raster):
        return Raster.open(raster, **settings)
    default = dict(band=1, layer=None, variance=VARIANCE, epsg=None, origin=(0.0, 0.0), height=0.0)
    given = ", ".join(name for name, value in settings.items() if value != default[name])
    require(not given, given, "must be left out for a Raster, which has its own", "another", "give them to Raster.open")
    return raster


def _to_cells(extent: Sequence[float], resolution: float) -> Box:
    """Return the cells that an extent x_min, x_max, y_min, y_max [m] touches."""
    cells = [value / resolution for value in extent]
    (x, x_end), (y, y_end) = ([math.floor(cells[k] + _ROUNDING), math.ceil(cells[k + 1] - _ROUNDING)] for k in (0, 2))
    return Box((x, y), (x_end, y_end))


def _some(parts: Iterator[Merged], name: str) -> Iterator[Merged]:
    """Yield parts; ValueError at the end if there was none."""
    number = 0
    for number, part in enumerate(parts, 1):  # noqa: B007
        yield part
    if not number:
        hint = "check area=, origin= and the raster's nodata value"
        raise ValueError(message(name, "must hold known heights in the area", "none", hint))
