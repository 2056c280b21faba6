"""Rasters that GDAL writes, for tests that read them."""

import numpy as np
import rasterio
from rasterio.transform import Affine


def turned(angle, side, corner=(0.0, 0.0), aspect=1.0):
    """The transform of pixels with these sides, whose columns run at an angle [degrees] to x, rows to the right."""
    c, s = np.cos(np.radians(angle)) * side, np.sin(np.radians(angle)) * side
    return Affine(c, s * aspect, corner[0], s, -c * aspect, corner[1])


def place(transform, column, row):
    """What a transform makes of a column and a row."""
    a, b, c, d, e, f = transform[:6]
    return a * column + b * row + c, d * column + e * row + f


def write_tif(path, bands, transform, *, crs="EPSG:32632", nodata=None, scale=None, offset=None, mask=None, **profile):
    """Write bands (rows, columns) as a GeoTIFF."""
    bands = np.asarray(bands) if np.ndim(bands) == 3 else np.asarray(bands)[None]
    count, height, width = bands.shape
    options = dict(driver="GTiff", count=count, height=height, width=width, dtype=bands.dtype, transform=transform)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        with rasterio.open(path, "w", **options, crs=crs, nodata=nodata, **profile) as dataset:
            dataset.write(bands)
            if scale is not None:
                dataset.scales, dataset.offsets = [scale] * count, [offset] * count
            if mask is not None:
                dataset.write_mask(mask)
    return path
