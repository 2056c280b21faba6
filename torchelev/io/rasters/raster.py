"""`Raster`: ground that was known before, from a GeoTIFF, a GridMap or a saved map."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchelev.errors import require, require_positive
from torchelev.io.geotiff import check_epsg
from torchelev.io.rasters.pixels import Pixels, fingerprint, layer_pixels
from torchelev.io.rasters.resample import Cells, resample
from torchelev.maps.centering import center_on
from torchelev.stages.initialize import Remembered, recall
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from torchelev.elevation_map import ElevationMap

VARIANCE = 0.09  # [m^2] a standard deviation of 0.3 m, as of terrain models from aeroplanes


class Raster:
    """Prior ground: heights of a file, all with one variance, for cells of any size.

    ```python
    raster = Raster.open("terrain.tif", origin=(465_000.0, 5_247_000.0), height=412.0)
    emap.initialize_from(raster, T_map_base)
    ```

    `torchelev.io.rasters.resample` states how pixels become cells.

    Args:
        pixels: the heights and their place in the map frame.
        variance: [m^2] of them.
        height: [m] of the map frame's origin in them, which is subtracted.
    """

    def __init__(self, pixels: Pixels, variance: float = VARIANCE, height: float = 0.0) -> None:
        require_positive(variance=variance)
        require(math.isfinite(height), "height", "must be a finite number of metres", height, "give 0.0, say")
        self._pixels, self.variance, self.height = pixels, float(variance), float(height)

    @classmethod
    def open(
        cls,
        path: str | Path,
        *,
        band: int = 1,
        layer: str | None = None,
        variance: float = VARIANCE,
        epsg: int | None = None,
        origin: tuple[float, float] = (0.0, 0.0),
        height: float = 0.0,
    ) -> Raster:
        """Open a raster; its heights are read when they are needed.

        Args:
            path: a GeoTIFF, plain or cloud-optimised, north up or turned, or another file that GDAL reads; an `.npz` of
                `save_npz` or `SiteMap.export`; or a bag, whose last GridMap counts.
            band: number of the band, from 1 on, for files that GDAL reads.
            layer: name of the band or layer, in place of `band`; of an `.npz` or a bag, None is "elevation".
            variance: [m^2] of the heights.
            epsg: code of the projected coordinate system that the file must have; None: any one in metres, or none.
            origin: easting and northing [m] of the map frame's origin; x points east, y north.
            height: [m] of the map frame's origin in the file's heights, which is subtracted.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file cannot be read, is not georeferenced, in degrees or in feet, is in another coordinate
                system than `epsg`, or an argument breaks its rule.
            KeyError: there is no such layer.
            ModuleNotFoundError: a package is missing; the text says which extra installs it.
        """
        check_epsg(epsg)
        is_point = len(origin) == 2 and all(math.isfinite(value) for value in origin)
        require(is_point, "origin", "expected easting and northing in metres", repr(origin), "give (0.0, 0.0), say")
        return cls(_open_pixels(path, band, layer, epsg, origin), variance, height)

    @classmethod
    def of_layer(
        cls, heights: NDArray, center: NDArray, resolution: float, *, variance: float = VARIANCE, height: float = 0.0
    ) -> Raster:
        """Return the raster of a layer in memory, such as of `read_grid_map(path, topic)`.

        Args:
            heights: (H, W) [m], i along x and j along y; what is not finite is unknown.
            center: x, y [m] of the layer's centre, map frame.
            resolution: [m] of its cells.
            variance: [m^2] of the heights.
            height: [m] of the map frame's origin in the heights, which is subtracted.

        Raises:
            ValueError: an argument breaks its rule.
        """
        heights = np.asarray(heights)
        is_layer = heights.ndim == 2 and heights.size > 0 and heights.dtype.kind in "iuf"
        actual = f"{heights.shape} {heights.dtype}"
        require(is_layer, "heights", "expected (H, W) numbers", actual, "give one layer")
        require_positive(resolution=resolution)
        return cls(layer_pixels("heights", heights, center, resolution), variance, height)

    @property
    def name(self) -> str:
        """The path, or what it is made of."""
        return self._pixels.name

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the heights and the size of the pixels; reads all of them."""
        return fingerprint(self._pixels)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """The borders x_min, x_max, y_min, y_max [m] of the box around its pixels, map frame."""
        rows, columns = self._pixels.shape
        xy = self._pixels.place.to_map(np.array([(0, 0), (columns, 0), (0, rows), (columns, rows)], np.float64))
        (x_min, y_min), (x_max, y_max) = xy.min(0).tolist(), xy.max(0).tolist()
        return x_min, x_max, y_min, y_max

    def heights(self, corner: tuple[int, int], size: tuple[int, int], resolution: float) -> NDArray[np.float32]:
        """Return the heights (H, W) [m] of cells, NaN where unknown.

        Args:
            corner: number of the first cell on the lattice, along x and y.
            size: H, W.
            resolution: [m] of the cells.
        """
        return (resample(self._pixels, Cells(corner, size, resolution)) - self.height).astype(np.float32)

    def fill_state(
        self, emap: ElevationMap, T_map_base: Float[Tensor, "B 4 4"] | None, chosen: Bool[Tensor, "B"]
    ) -> MapState:
        """Return a map's state with the raster filled in; `ElevationMap.initialize_from` calls it."""
        limit = emap.cfg.fusion.max_variance
        hint = "give a smaller one to Raster.open"
        require(self.variance < limit, "variance", f"must be below fusion.max_variance, {limit:g}", self.variance, hint)
        state = emap.state
        if T_map_base is not None:
            state = center_on(state, emap, T_map_base, chosen)
        elevation = torch.full(state.elevation.shape, torch.nan)
        H, W = elevation.shape[1:]
        for env in chosen.nonzero()[:, 0].tolist():
            x, y = state.corner[env].tolist()
            elevation[env] = torch.from_numpy(self.heights((x, y), (H, W), emap.cfg.grid.resolution))
        elevation = elevation.to(chosen.device)
        same, unknown = torch.full_like(elevation, self.variance), torch.full_like(elevation, torch.nan)
        before = Remembered(elevation, same, torch.zeros_like(elevation), unknown)
        return recall(state, before, chosen, limit, 0.0)  # the first measurement prevails


def _open_pixels(
    path: str | Path, band: int, layer: str | None, epsg: int | None, origin: tuple[float, float]
) -> Pixels:
    """Return the pixels of a file of any kind."""
    from torchelev.io.bags import is_bag

    is_npz = Path(path).suffix.lower() == ".npz"
    if not is_npz and not is_bag(Path(path)):
        from torchelev.io.rasters.gdal_pixels import GdalPixels

        return GdalPixels(path, band, layer, epsg, origin)
    require(epsg is None, "epsg", "must be None, except for files that GDAL reads", epsg, "leave it out")
    require(band == 1, "band", "must be left out, except for files that GDAL reads", band, "give layer=")
    saved: Any
    if is_npz:
        from torchelev.io.export import load_npz as read
    else:
        from torchelev.io.bags import read_grid_map as read  # type: ignore[assignment]
    saved, name = read(path), "elevation" if layer is None else layer
    listed = ", ".join(saved.layers)
    require(name in saved.layers, "layer", f"must be one of {path}", repr(name), f"layers are {listed}", KeyError)
    return layer_pixels(str(path), saved.layers[name], saved.center[:2] - np.array(origin), saved.resolution)
