#!/usr/bin/env bash
# GDAL 3.10.3, in rasterio 1.4.4: is a pixel of an "average" overview the mean of the known pixels below it?
#
# Eight by eight pixels, NaN is nodata. In each block of 4 x 4, one quarter has four known pixels of 0 m, and each of
# the other three quarters has one known pixel of 10 m.
# Expected at factor 4, as gdaladdo says, "the average of all non-NODATA contributing pixels": the mean of seven pixels,
# 30 / 7 = 4.29 m.
# Seen: 7.50 m, also by the driver COG. Factor 4 is made of factor 2, where a pixel with one known pixel below it counts
# as much as one with four. Made in a call of its own, factor 4 is 4.29 m, also behind factor 2: build one at a time.
#
# Exits 0 while that holds. Installs into a temporary folder, 160 MB; needs Python 3.10 to 3.13.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check rasterio==1.4.4 numpy==2.2.6
cd "$folder"
venv/bin/python - <<'PYTHON'
import sys

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.enums import Resampling
from rasterio.transform import from_origin

block = np.full((4, 4), np.nan, np.float32)
block[:2, :2], block[0, 2], block[2, 0], block[2, 2] = 0, 10, 10, 10
heights = np.tile(block, (2, 2))
place = dict(crs="EPSG:32632", transform=from_origin(465000, 5247000, 1, 1), nodata=np.nan)


def overview(*calls):
    with rasterio.open("a.tif", "w", driver="GTiff", width=8, height=8, count=1, dtype="float32", **place) as dataset:
        dataset.write(heights, 1)
    for factors in calls:
        with rasterio.open("a.tif", "r+") as dataset:
            dataset.build_overviews(factors, Resampling.average)
    with rasterio.open("a.tif", overview_level=1) as dataset:
        return dataset.read(1)


def overview_of_cog():
    size = dict(width=1024, height=1024, count=1, dtype="float32")
    with rasterio.open("b.tif", "w", driver="GTiff", **size, **place) as dataset:
        dataset.write(np.tile(block, (256, 256)), 1)
    rasterio.shutil.copy("b.tif", "c.tif", driver="COG", OVERVIEW_RESAMPLING="AVERAGE", BLOCKSIZE="256")
    with rasterio.open("c.tif", overview_level=1) as dataset:
        return dataset.read(1)


both, alone, cog = overview([2, 4]), overview([2], [4]), overview_of_cog()
mean = np.nanmean(block)
print(f"GDAL {rasterio.__gdal_version__}; the mean of the known pixels is {mean:.2f} m; at factor 4:")
print(f"built with factor 2 {both[0, 0]:.2f} m, after it {alone[0, 0]:.2f} m, by the driver COG {cog[0, 0]:.2f} m")
holds = np.allclose(both, 7.5) and np.allclose(cog, 7.5) and np.allclose(alone, mean)
print("as before" if holds else "changed")
sys.exit(not holds)
PYTHON
