"""Rasters of other programs: GeoTIFF written cloud-optimised; GeoTIFF, GridMap and `.npz` read as prior ground.

The plain GeoTIFF of a map's window is written by `torchelev.io.geotiff`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchelev.lazy_names import import_later

if TYPE_CHECKING:
    from torchelev.io.rasters.cog import write_cog
    from torchelev.io.rasters.raster import Raster

__all__ = ["Raster", "write_cog"]

_LATER = {"Raster": "torchelev.io.rasters.raster", "write_cog": "torchelev.io.rasters.cog"}
__getattr__, __dir__ = import_later(__name__, _LATER)
