"""Pixels of a GeoTIFF, or of another file that GDAL reads. Needs ``torchelev[geo]``."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.errors import require
from torchelev.io.rasters.pixels import Part, Place

_CACHE = 64 << 20  # bytes of blocks that GDAL keeps
_METRES = (None, "", "m", "metre", "meter", "metres", "meters")
_REPROJECT = "reproject it: gdalwarp -t_srs EPSG:32632 in.tif out.tif, say"


class GdalPixels:
    """One band of a file: its nodata value, masks, scale and offset are respected.

    Args:
        path: of the file.
        band: number of the band, from 1 on.
        layer: description of the band, in place of its number; None: `band` chooses.
        epsg: code of the projected coordinate system that it must have; None: any one.
        origin: easting and northing [m] of the map frame's origin.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: GDAL cannot read it, it is not georeferenced, not in metres, or not in the given system.
        KeyError: no band has this description.
        ModuleNotFoundError: rasterio is missing.
    """

    def __init__(
        self, path: str | Path, band: int, layer: str | None, epsg: int | None, origin: tuple[float, float]
    ) -> None:
        self._dataset, self.name = _open(path), str(path)
        self._band = _find_band(self.name, self._dataset, band, layer)
        self.shape = (int(self._dataset.height), int(self._dataset.width))
        self._scale, self._offset = (values[self._band - 1] for values in (self._dataset.scales, self._dataset.offsets))
        _require_metres(self.name, self._dataset, self._band)
        _require_system(self.name, self._dataset.crs, epsg)
        self.place = _find_place(self.name, self._dataset, origin)

    def read(self, part: Part) -> NDArray[np.float64]:
        """Return heights [m] of a part, NaN where unknown."""
        import rasterio
        from rasterio.windows import Window

        window = Window(part.first[1], part.first[0], part.size[1], part.size[0])
        with rasterio.Env(GDAL_CACHEMAX=_CACHE):
            values = self._dataset.read(self._band, window=window, masked=True)
        heights = np.ma.getdata(values).astype(np.float64) * self._scale + self._offset
        return np.where(np.ma.getmaskarray(values) | ~np.isfinite(heights), np.nan, heights)


def _open(path: str | Path) -> Any:
    try:
        import rasterio
    except ModuleNotFoundError as error:
        text = f'{path} needs rasterio: pip install "torchelev[geo]"'
        raise ModuleNotFoundError(text, name=error.name) from error
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    is_there = "://" in str(path) or str(path).startswith("/vsi") or Path(path).exists()
    require(
        is_there, "raster", "must be a file", f"{str(path)!r}, where nothing is", "check the path", FileNotFoundError
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)  # which is an error below
            return rasterio.open(path)
    except RasterioError as error:
        text = f"{path}: must be a GeoTIFF or another raster that GDAL reads, an .npz or a bag, got {error}"
        raise ValueError(text) from error


def _find_band(name: str, dataset: Any, band: int, layer: str | None) -> int:
    names = [text or "without a name" for text in dataset.descriptions]
    listed = ", ".join(f"{k} {text}" for k, text in enumerate(names, 1))
    if layer is not None:
        require(layer in names, "layer", f"must be a band of {name}", repr(layer), f"bands are {listed}", KeyError)
        return names.index(layer) + 1
    is_band = isinstance(band, (int, np.integer)) and 1 <= band <= dataset.count
    require(is_band, "band", f"must be from 1 to {dataset.count} for {name}", repr(band), f"bands are {listed}")
    return int(band)


def _require_metres(name: str, dataset: Any, band: int) -> None:
    """Raise ValueError unless a band holds real numbers in metres."""
    kind, unit = dataset.dtypes[band - 1], dataset.units[band - 1]
    require(not kind.startswith("complex"), name, "must hold real numbers", kind, "choose another band")
    is_metre = unit is None or unit.lower() in _METRES
    require(is_metre, name, "must hold heights in metres", f"a band in {unit}", "convert it with gdal_calc.py")


def _require_system(name: str, crs: Any, epsg: int | None) -> None:
    """Raise ValueError unless a coordinate system is projected, in metres, and the given one; one may be missing."""
    if crs is None:
        return
    from rasterio.crs import CRS

    text = crs.to_string()
    text = text if len(text) < 60 else f"{text[:60]}..."
    rule = "must be in a projected coordinate system"
    require(not crs.is_geographic, name, rule, f"{text}, whose coordinates are degrees", _REPROJECT)
    unit, factor = crs.linear_units_factor
    require(abs(factor - 1) < 1e-9, name, "must be in metres", f"{text}, whose unit is {unit}", _REPROJECT)
    if epsg is not None:
        horizontal = _take_horizontal(crs)
        is_same = horizontal.to_epsg() == epsg or horizontal == CRS.from_epsg(epsg)
        require(is_same, "epsg", f"must be that of {name}, {text}", epsg, "give that one, or reproject the raster")


def _take_horizontal(crs: Any) -> Any:
    """Return the projected part of a system that has heights, too."""
    from rasterio.crs import CRS

    text = crs.to_wkt()
    start = text.find("PROJCS[")
    if not text.startswith("COMPD_CS[") or start < 0:
        return crs
    depth = 0
    for end in range(start, len(text)):
        depth += {"[": 1, "]": -1}.get(text[end], 0)
        if depth == 0 and text[end] == "]":
            return CRS.from_wkt(text[start : end + 1])
    return crs


def _find_place(name: str, dataset: Any, origin: tuple[float, float]) -> Place:
    transform = dataset.transform
    hint = "set its place with gdal_edit.py -a_ullr, say"
    require(not transform.is_identity, name, "must be georeferenced by an affine transform", "none", hint)
    matrix = np.array([[transform.a, transform.b], [transform.d, transform.e]])
    is_regular = abs(np.linalg.det(matrix)) > 1e-12 * np.abs(matrix).max() ** 2
    require(bool(is_regular), name, "must have pixels with an area", matrix.tolist(), hint)
    return Place(matrix, np.array([transform.c, transform.f]) - np.array(origin, np.float64))
