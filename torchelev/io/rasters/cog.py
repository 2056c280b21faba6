"""Cloud-optimised GeoTIFF, by GDAL. Needs ``torchelev[geo]``."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchelev.files.output_files import WriteError, atomic_path
from torchelev.io.geotiff import Bands, encode_bands

BLOCK = 256  # pixels on the side of a block
_CACHE = 64 << 20  # bytes of blocks that GDAL keeps


def write_cog(path: str | Path, blocks: Iterator[NDArray[np.float32]], bands: Bands) -> None:
    """Write bands as a cloud-optimised GeoTIFF, completely or not at all.

    A pixel of an overview is the mean of all known pixels below it, and unknown if there is none. Blocks are compressed
    by deflate without a predictor, which readers without GDAL know, too. Beside the file, a plain one takes as much
    room until it is complete.

    Args:
        path: of the file.
        blocks: of `BLOCK` x `BLOCK` pixels: all of the first band, row by row from north to south, and so on.
        bands: their names and place.

    Raises:
        WriteError: the file cannot be written; an existing file is left as it was.
        ModuleNotFoundError: tifffile or rasterio is missing.
    """
    import rasterio  # noqa: F401  # before anything is written

    with atomic_path(path) as unfinished:
        plain = unfinished.with_suffix(".plain")
        try:
            with plain.open("xb") as file:
                encode_bands(file, blocks, bands, BLOCK)
            factors = [2**k for k in range(1, math.ceil(math.log2(max(*bands.shape, 2) / BLOCK)) + 1)]
            with _errors_of_gdal(path):
                _add_overviews(plain, factors)
                _require_complete(plain, len(factors), path)
                _copy(plain, unfinished, len(bands.names))
                _require_complete(unfinished, len(factors), path)
        finally:
            plain.unlink(missing_ok=True)


def _add_overviews(plain: Path, factors: list[int]) -> None:
    """Add an overview to a GeoTIFF for each factor."""
    import rasterio
    from rasterio.enums import Resampling

    settings = {"COMPRESS_OVERVIEW": "DEFLATE", "GDAL_TIFF_OVR_BLOCKSIZE": BLOCK}
    with rasterio.Env(GDAL_CACHEMAX=_CACHE, **settings):
        for factor in factors:  # made together, each would be of the one before: a mean of means
            with rasterio.open(plain, "r+") as dataset:
                dataset.build_overviews([factor], Resampling.average)


def _copy(plain: Path, optimised: Path, num_bands: int) -> None:
    """Copy a GeoTIFF with overviews to one that has all its tables first, and the smallest overview before others."""
    import rasterio
    import rasterio.shutil

    options = {"COMPRESS": "DEFLATE", "TILED": "YES", "BLOCKXSIZE": BLOCK, "BLOCKYSIZE": BLOCK, "BIGTIFF": "IF_SAFER"}
    if num_bands > 1:
        options["INTERLEAVE"] = (
            "BAND"  # a reader of the elevation fetches nothing else; GDAL's driver COG: from 3.11 on
        )
    with rasterio.Env(GDAL_CACHEMAX=_CACHE):
        rasterio.shutil.copy(str(plain), str(optimised), driver="GTiff", COPY_SRC_OVERVIEWS="YES", **options)


def _require_complete(file: Path, num_overviews: int, path: str | Path) -> None:
    """Raise WriteError unless a GeoTIFF has all overviews and blocks: a full disk may be no error to GDAL."""
    import tifffile

    size, pages, blocks = file.stat().st_size, [], []
    with suppress(tifffile.TiffFileError), tifffile.TiffFile(file) as tiff:
        pages = list(tiff.pages)
        blocks = [block for page in pages for block in zip(page.dataoffsets, page.databytecounts, strict=True)]
    has_all = len(pages) == num_overviews + 1
    if not has_all or not all(start > 0 and number > 0 and start + number <= size for start, number in blocks):
        raise WriteError(path, "GDAL has left it incomplete: is the disk full?")


@contextmanager
def _errors_of_gdal(path: str | Path) -> Iterator[None]:
    """Raise errors of GDAL in the block, such as of a full disk, as WriteError."""
    from rasterio.errors import RasterioError

    try:
        yield
    except Exception as error:
        is_from_gdal = isinstance(error, (RasterioError, SystemError)) or type(error).__module__ == "rasterio._err"
        if not is_from_gdal:
            raise
        raise WriteError(path, f"GDAL: {error}") from error
