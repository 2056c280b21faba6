"""Files of a site for other programs: GeoTIFF, pictures with a world file, meshes and NumPy arrays."""

from __future__ import annotations

import importlib
import math
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from torchelev.errors import message, require
from torchelev.files.output_files import MARK, atomic_file, require_writable
from torchelev.io.export import SavedMap, triangulate, write_npz, write_ply
from torchelev.io.geotiff import Bands, check_epsg, color_roles
from torchelev.io.rasters.cog import BLOCK, write_cog
from torchelev.site.content.reading import sources_of
from torchelev.site.content.tiles import TILE, Tiles

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MAX_CELLS = {".png": 8192**2, ".ply": 4000**2, ".npz": 8192**2}  # which need about 3 GB of memory
# Packages, and the extras that install them.
_PACKAGES = {".tif": (("tifffile", "rasterio"), "geo"), ".png": (("cv2",), "io"), ".ply": (("plyfile",), "io")}
_UNIX_FROM, _UNIX_TO = 1e9, 2.5e11  # [s] from 2001 to 9892: a clock that counts from a start shows less
_ROUNDING = 1e-6  # of a cell
_AMBIENT = 0.35  # brightness of slopes that face away from the light

Copy = Callable[[tuple[int, int], tuple[int, int], Sequence[str]], SavedMap]  # first cell, H and W, layers


class Area(NamedTuple):
    """The area and layers to export."""

    corner: tuple[int, int]  #: number of the first cell
    size: tuple[int, int]  #: H, W in cells
    layers: tuple[str, ...]  #: names
    resolution: float  #: [m]
    copy: Copy  #: reads a part of it
    colors: dict[str, str]  #: layers that are Red, Green or Blue


class Place(NamedTuple):
    """Where the map frame lies on the Earth."""

    epsg: int | None  #: code of the projected coordinate system
    origin: tuple[float, float]  #: [m] easting and northing


class Moment(NamedTuple):
    """The version of the site that is exported."""

    version: str  #: its id
    time: float  #: [s] of its last merge

    @property
    def date(self) -> str | None:
        """The time as TIFF writes it, in UTC; None unless it counts from 1970, as those from 2001 on do."""
        if not _UNIX_FROM <= self.time < _UNIX_TO:
            return None
        return datetime.fromtimestamp(math.floor(self.time), timezone.utc).strftime("%Y:%m:%d %H:%M:%S")


def choose_area(
    tiles: Tiles, layers: tuple[str, ...], extent: Sequence[float] | None, resolution: float, copy: Copy
) -> Area:
    """Return the area of an extent x_min, x_max, y_min, y_max [m]; None: the box around all known cells."""
    require(len(layers) > 0, "layers", "must be names of one or more layers", "none", 'give ("elevation",), say')
    if extent is None:
        sides = [[_find_border(tiles, layers, axis, end) for end in (False, True)] for axis in (0, 1)]
    else:
        check_box(extent)
        cells = [value / resolution for value in extent]
        sides = [[math.floor(cells[k] + _ROUNDING), math.ceil(cells[k + 1] - _ROUNDING)] for k in (0, 2)]
    (x, x_end), (y, y_end) = sides
    rows, columns = range(x // TILE, (x_end - 1) // TILE + 1), range(y // TILE, (y_end - 1) // TILE + 1)
    is_there = any(a in rows and b in columns for a, b in tiles)
    require(is_there, "area", "must hold known cells", f"nothing known in {extent}", "see site.extent")
    return Area((x, y), (x_end - x, y_end - y), layers, resolution, copy, color_roles(tiles.channels.configs))


def check_box(extent: Sequence[float]) -> None:
    """Raise ValueError unless an extent is x_min, x_max, y_min, y_max."""
    box = np.asarray(extent)
    is_box = box.shape == (4,) and box.dtype.kind in "iuf" and bool(np.isfinite(box).all())
    is_box = is_box and bool(box[0] < box[1] and box[2] < box[3])
    require(is_box, "area", "expected x_min, x_max, y_min, y_max in metres", repr(extent), "see site.extent")


def export(path: str | Path, area: Area, place: Place, moment: Moment) -> None:
    """Write an area to a file in the format of its suffix."""
    suffix = Path(path).suffix.lower().replace(".tiff", ".tif")
    writers: dict[str, Callable[[str | Path, Area, Place], None]] = {
        ".tif": partial(_write_tif, moment=moment),
        ".png": _write_png,
        ".ply": _write_ply,
        ".npz": _write_npz,
    }
    require(suffix in writers, "path", f"must end with {', '.join(writers)}", repr(str(path)), "choose one of these")
    _check_place(suffix, place)
    if suffix in (".png", ".ply"):
        require(len(area.layers) == 1, "layers", f"must be one for {suffix}", len(area.layers), "write .tif or .npz")
    _check_size(suffix, area)
    _import(suffix)
    require_writable(path)  # before anything is, as there may be two files
    writers[suffix](path, area, place)


def _find_border(tiles: Tiles, layers: tuple[str, ...], axis: int, is_end: bool) -> int:
    """Return the number of the first known cell along an axis, or one past the last; reads tiles at that end only."""
    rows = [tiles.layers.index(source) for source in sources_of(layers, tiles)]
    for line in sorted({tile[axis] for tile in tiles}, reverse=is_end):
        chosen = [tile for tile in tiles if tile[axis] == line]
        known = np.zeros(TILE, bool)
        for k in range(0, len(chosen), BLOCK):
            is_known = tiles.read(chosen[k : k + BLOCK])[rows].isfinite().any(0)
            known |= is_known.any(0).any(1 - axis).cpu().numpy()
        if known.any():
            return int(line * TILE + (known.nonzero()[0][-1] + 1 if is_end else known.nonzero()[0][0]))
    hint = "choose other layers" if len(tiles) else "merge a map that has measured first"
    raise ValueError(message("site", "must have known cells to export", f"none of {', '.join(layers)}", hint))


def _check_place(suffix: str, place: Place) -> None:
    check_epsg(place.epsg)
    is_used = suffix == ".tif" or place.epsg is None
    require(is_used, "epsg", "must be None, except for .tif", place.epsg, "write a .tif")
    is_point = len(place.origin) == 2 and all(math.isfinite(value) for value in place.origin)
    require(is_point, "origin", "expected easting and northing in metres", repr(place.origin), "give (0.0, 0.0), say")
    is_used = suffix in (".tif", ".png") or not any(place.origin)
    require(is_used, "origin", "must be (0, 0), except for .tif and .png", place.origin, "these keep the map frame")


def _check_size(suffix: str, area: Area) -> None:
    most, (H, W) = _MAX_CELLS.get(suffix), area.size
    if most is not None:
        actual = f"{H} x {W} cells, {H * area.resolution:g} x {W * area.resolution:g} m"
        side = math.isqrt(most // len(area.layers)) * area.resolution
        fits = H * W * len(area.layers) <= most
        rule = f"must be of at most {most} cells for {suffix}"
        require(fits, "area", rule, actual, f"give an area such as {side:g} x {side:g} m, or write .tif")


def _import(suffix: str) -> None:
    """Import what the writer needs; ModuleNotFoundError says how to install it."""
    packages, extra = _PACKAGES.get(suffix, ((), ""))
    for package in packages:
        try:
            importlib.import_module(package)
        except ModuleNotFoundError as error:
            text = f'{suffix} needs {package}: pip install "torchelev[{extra}]"'
            raise ModuleNotFoundError(text, name=error.name) from error


# Writers --------------------------------------------------------------------------------------------------------------


def _write_tif(path: str | Path, area: Area, place: Place, moment: Moment) -> None:
    north_west, shape = _find_north_west(area, place), area.size[::-1]
    items = {"SITE_VERSION": moment.version, "SITE_TIME": repr(moment.time)}
    about = Bands(area.layers, shape, area.resolution, north_west, place.epsg, area.colors, items, moment.date)
    write_cog(path, _read_blocks(area), about)


def _find_north_west(area: Area, place: Place) -> tuple[float, float]:
    """Return easting and northing [m] of the outer corner of the first pixel."""
    west, north = area.corner[0] * area.resolution, (area.corner[1] + area.size[1]) * area.resolution
    return west + place.origin[0], north + place.origin[1]


def _read_blocks(area: Area) -> Iterator[NDArray[np.float32]]:
    """Yield the blocks of each layer, rows from north to south, as GeoTIFF has them."""
    (x, y), (H, W) = area.corner, area.size
    for name in area.layers:
        for north in range(y + W, y, -BLOCK):
            for west in range(x, x + H, BLOCK):
                block = area.copy((west, north - BLOCK), (BLOCK, BLOCK), (name,))
                yield np.ascontiguousarray(_north_up(block.layers[name]), np.float32)


def _write_png(path: str | Path, area: Area, place: Place) -> None:
    """Write a shaded, coloured picture, transparent where unknown, and the world file that says where it lies."""
    import cv2

    values = _north_up(area.copy(area.corner, area.size, area.layers).layers[area.layers[0]])
    known = np.isfinite(values)
    require(bool(known.any()), "area", "must hold known cells", "nothing known", "see site.extent")
    low, high = float(values[known].min()), float(values[known].max())
    levels = np.nan_to_num((values - low) * (255 / max(high - low, 1e-9))).astype(np.uint8)
    picture = cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)
    if "elevation" in area.layers[0] or area.layers[0] == "upper_bound":
        picture = (picture * _shade(values, area.resolution)[..., None]).astype(np.uint8)
    picture = np.dstack([picture, np.where(known, 255, 0).astype(np.uint8)])
    text = f"{area.layers[0]} from {low:g} (dark blue) to {high:g} (yellow), written by {MARK}"
    data = _describe(cv2.imencode(".png", picture)[1].tobytes(), text)
    west, north = _find_north_west(area, place)
    half = area.resolution / 2
    lines = (area.resolution, 0.0, 0.0, -area.resolution, west + half, north - half)
    with atomic_file(Path(path).with_suffix(".pgw")) as file:
        file.write("".join(f"{value:.12g}\n" for value in lines).encode())
    with atomic_file(path) as file:
        file.write(data)


def _shade(values: NDArray, resolution: float) -> NDArray[np.float32]:
    """Return the brightness of each cell in light from the north-west, at 45 degrees; 1 next to unknown cells."""
    if min(values.shape) < 2:
        return np.ones(values.shape, np.float32)
    south, east = np.gradient(values, resolution)
    light = (1 + (east + south) / math.sqrt(2)) / np.sqrt(1 + east**2 + south**2)
    return np.where(np.isfinite(light), np.clip(light, _AMBIENT, 1), 1).astype(np.float32)


def _describe(png: bytes, text: str) -> bytes:
    """Insert a text into a picture, behind its header of 33 bytes."""
    chunk = b"tEXtDescription\0" + text.encode("latin-1")
    return png[:33] + struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) + png[33:]


def _write_ply(path: str | Path, area: Area, place: Place) -> None:
    saved = area.copy(area.corner, area.size, area.layers)
    write_ply(path, *triangulate(saved.layers[area.layers[0]], saved.center, saved.resolution))


def _write_npz(path: str | Path, area: Area, place: Place) -> None:
    write_npz(path, area.copy(area.corner, area.size, area.layers))


def _north_up(layer: NDArray[Any]) -> NDArray[Any]:
    """Return a layer (H, W) with rows from north to south and columns from west to east."""
    return np.flipud(layer.T)
