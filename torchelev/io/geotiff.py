"""Maps as GeoTIFF, for geographic information systems such as QGIS. Needs ``torchelev[geo]``."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import NDArray

from torchelev.channels.config import ChannelConfig
from torchelev.errors import message, require
from torchelev.files.output_files import MARK, atomic_file
from torchelev.io.export import take

if TYPE_CHECKING:
    from torchelev.elevation_map import ElevationMap

# Tags of GeoTIFF 1.1 (OGC 19-008r4), and two of GDAL's.
_PIXEL_SCALE, _TIE_POINT, _GEO_KEYS, _GDAL_METADATA, _GDAL_NODATA = 33550, 33922, 34735, 42112, 42113
_MODEL_TYPE, _RASTER_TYPE, _PROJECTED_CRS = 1024, 1025, 3072
_PROJECTED, _PIXEL_IS_AREA = 1, 1
_SHORT, _DOUBLE, _ASCII = 3, 12, 2
_COLORS = ("Red", "Green", "Blue")
_MAX_CLASSIC = 2**32 - 2**25  # bytes of the values, beyond which offsets need 64 bits


def save_geotiff(
    path: str | Path,
    emap: ElevationMap,
    env: int = 0,
    layers: Sequence[str] | None = None,
    *,
    epsg: int | None = None,
    origin: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Write layers of one environment as bands of a GeoTIFF, float32, NaN where unknown.

    The map frame's x must point east and its y north, as in ROS (REP 103). Rows run from north to south. A channel of
    several components is a band for each; those of colours, from 0 to 1, are marked as red, green and blue.

    Args:
        path: of the file.
        emap: the map.
        env: the environment.
        layers: names as in `ElevationMap.layer`, in the order of the bands, or of channels; None: all of them.
        epsg: code of the projected coordinate system, such as 32632 for UTM zone 32N; None: none is written.
        origin: easting and northing [m] of the map frame's origin in it.

    Raises:
        KeyError: a layer does not exist. Nothing is written then.
        ValueError: the environment does not exist, or `epsg` is not a code.
        ModuleNotFoundError: tifffile is missing.
    """
    import tifffile  # noqa: F401  # before the layers are read

    check_epsg(epsg)
    channels = {name: cfg.components(name) for name, cfg in emap.cfg.channels.items()}
    names = [part for name in (emap.layers if layers is None else layers) for part in channels.get(name, (name,))]
    taken = take(emap, env, names)
    values = np.stack([np.flipud(taken.layers[name].T) for name in names]).astype(np.float32)
    x_min, _, _, y_max = taken.extent
    north_west = x_min + origin[0], y_max + origin[1]
    bands = Bands(names, values.shape[1:], taken.resolution, north_west, epsg, color_roles(emap.cfg.channels))
    with atomic_file(path) as file:
        encode_bands(file, values, bands)


def color_roles(channels: Mapping[str, ChannelConfig]) -> dict[str, str]:
    """Return which components of channels are Red, Green or Blue, by their names."""
    colors = {name: cfg for name, cfg in channels.items() if cfg.is_color}
    return {
        part: role for name, cfg in colors.items() for part, role in zip(cfg.components(name), _COLORS, strict=True)
    }


def check_epsg(epsg: object) -> None:
    """Raise ValueError unless it may be the code of a projected coordinate system, or None."""
    is_code = epsg is None or (isinstance(epsg, int) and 1024 <= epsg <= 32767)
    rule, hint = "must be the code of a projected system in metres, 1024 to 32767", "give 32632, say"
    require(is_code, "epsg", rule, repr(epsg), hint)
    if epsg is not None and find_spec("rasterio") is not None:
        from rasterio.crs import CRS
        from rasterio.errors import CRSError

        try:
            system = CRS.from_epsg(epsg)
        except CRSError as error:
            raise ValueError(message("epsg", rule, f"{epsg}, which is unknown", hint)) from error
        is_metric = system.is_projected and system.linear_units_factor[1] == 1.0
        require(is_metric, "epsg", rule, f"{epsg}, which is not", hint)


class Bands(NamedTuple):
    """L bands of one size, and where they lie."""

    names: Sequence[str]  #: of the bands
    shape: tuple[int, ...]  #: rows, columns
    resolution: float  #: [m]
    north_west: tuple[float, float]  #: easting and northing [m] of the first pixel's outer corner
    epsg: int | None  #: code of the projected coordinate system; None: none is written
    colors: Mapping[str, str]  #: Red, Green or Blue of the bands, by name, that hold colours
    items: Mapping[str, str] = MappingProxyType({})  #: further metadata of the file, by name
    date: str | None = None  #: "YYYY:MM:DD HH:MM:SS" in UTC


def encode_bands(
    file: BinaryIO, values: NDArray[np.float32] | Iterator[NDArray[np.float32]], bands: Bands, block: int | None = None
) -> None:
    """Write bands to an open file as a GeoTIFF, rows from north to south, NaN where unknown.

    Args:
        file: open for writing.
        values: (L, rows, columns), or its blocks of block x block pixels: all of the first band, row by row, and so on.
        bands: their names and place.
        block: pixels on the side of a block, a multiple of 16; None: `values` is an array.
    """
    import tifffile

    options: dict[str, Any] = dict(photometric="minisblack", metadata=None, shape=(len(bands.names), *bands.shape))
    if len(bands.names) > 1:
        options["planarconfig"] = "separate"
    if block is not None:
        options.update(tile=(block, block), maxworkers=1)  # in one thread, so that few blocks wait in memory
    if 6 * math.prod(options["shape"]) > _MAX_CLASSIC:  # with overviews
        options["bigtiff"] = True
    options |= dict(datetime=bands.date, software=MARK, compression="zlib", extratags=_make_tags(bands))
    tifffile.imwrite(file, values, dtype=np.float32, **options)


def _make_tags(bands: Bands) -> list:
    keys, resolution = {_MODEL_TYPE: _PROJECTED, _RASTER_TYPE: _PIXEL_IS_AREA}, bands.resolution
    crs = (
        [] if bands.epsg is None else [_geo_keys({**keys, _PROJECTED_CRS: bands.epsg})]
    )  # GDAL makes a coordinate system of any keys
    return [
        *crs,
        (_PIXEL_SCALE, _DOUBLE, 3, (resolution, resolution, 0.0), True),
        (_TIE_POINT, _DOUBLE, 6, (0.0, 0.0, 0.0, *bands.north_west, 0.0), True),
        (_GDAL_METADATA, _ASCII, 0, _describe(bands), True),
        (_GDAL_NODATA, _ASCII, 0, "nan", True),
    ]


def _geo_keys(keys: dict[int, int]) -> tuple:
    """Return the tag of short keys: version 1.1.0, the number of keys, and four numbers for each."""
    numbers = [1, 1, 0, len(keys)]
    for key, value in keys.items():
        numbers += [key, 0, 1, value]
    return _GEO_KEYS, _SHORT, len(numbers), tuple(numbers), True


def _describe(bands: Bands) -> str:
    """Return further items, the names of the bands, and which of them are colours, as GDAL writes them."""
    names, colors = bands.names, bands.colors
    items = [f"<Item name={quoteattr(name)}>{escape(text)}</Item>" for name, text in bands.items.items()]
    items += [
        f'<Item name="DESCRIPTION" sample="{k}" role="description">{escape(name)}</Item>'
        for k, name in enumerate(names)
    ]
    items += [
        f'<Item name="COLORINTERP" sample="{k}" role="colorinterp">{colors[name]}</Item>'
        for k, name in enumerate(names)
        if name in colors
    ]
    return f"<GDALMetadata>{''.join(items)}</GDALMetadata>"
