"""The cloud-optimised GeoTIFF of a site, as GDAL, rasterio and xarray read it."""

import numpy as np
import pytest
import torch

from tests.helpers import without
from tests.site.helpers import robots
from torchelev.io.geotiff import Bands
from torchelev.io.rasters.cog import write_cog
from torchelev.site import SiteMap
from torchelev.site.site_export import Moment

rasterio = pytest.importorskip("rasterio")
rasterio_shutil = pytest.importorskip("rasterio.shutil")
PLACE = dict(epsg=32632, origin=(465_000.0, 5_247_000.0))


def blocks_of(layers):
    """The blocks of layers (L, rows, columns), padded to whole ones."""
    for layer in layers:
        rows, columns = (-size % 256 for size in layer.shape)
        padded = np.pad(layer, ((0, rows), (0, columns)), constant_values=np.nan)
        for row in range(0, padded.shape[0], 256):
            for column in range(0, padded.shape[1], 256):
                yield np.ascontiguousarray(padded[row : row + 256, column : column + 256])


@pytest.fixture(scope="module")
def patchy(tmp_path_factory):
    """A file of two bands, 1024 x 640, of which most pixels are unknown, each band others; and the bands."""
    rng, path = np.random.default_rng(0), tmp_path_factory.mktemp("cog") / "patchy.tif"
    layers = rng.normal(100.0, 5.0, (2, 1024, 640)).astype(np.float32)
    layers[0][rng.random(layers[0].shape) < 0.7] = np.nan
    layers[0, 512:600, 130:230] = np.nan
    layers[1, :, 320:] = np.nan
    write_cog(path, blocks_of(layers), Bands(("elevation", "variance"), (1024, 640), 0.1, (0.0, 0.0), None, {}))
    return path, layers


def means_of(layer, factor):
    """The means of the known ones of factor x factor pixels each, NaN where none is: computed apart from GDAL."""
    parts = layer.reshape(layer.shape[0] // factor, factor, layer.shape[1] // factor, factor).astype(float)
    known = np.isfinite(parts)
    number = known.sum((1, 3))
    return np.where(number, np.where(known, parts, 0).sum((1, 3)) / np.maximum(number, 1), np.nan)


@pytest.mark.slow(1)
@pytest.mark.parametrize("band", [1, 2])
def test_overviews_are_means_of_known_pixels(patchy, band):
    path, layers = patchy
    for level, factor in enumerate((2, 4)):
        expected = means_of(layers[band - 1], factor)
        with rasterio.open(path, overview_level=level) as dataset:
            assert np.isnan(dataset.nodata)
            actual = dataset.read(band)
            np.testing.assert_array_equal(np.isnan(actual), np.isnan(expected))
            np.testing.assert_allclose(actual, expected, rtol=1e-6)
            np.testing.assert_array_equal(dataset.read_masks(band) == 0, np.isnan(expected))
            assert np.isnan(expected).any()


def test_the_file_is_cloud_optimised(patchy):
    """Tables and overviews come first: every table before all pixels, and small overviews before large ones."""
    path, _ = patchy
    with rasterio.open(path) as dataset:
        assert dataset.block_shapes == [(256, 256)] * 2 and dataset.overviews(1) == dataset.overviews(2) == [2, 4]
    tifffile = pytest.importorskip("tifffile")
    with tifffile.TiffFile(path) as tiff:
        pages = [tiff.pages[0], *tiff.pages[0].pages] if tiff.pages[0].subifds else list(tiff.pages)
        first = [min(offset for offset in page.dataoffsets if offset) for page in pages]
        assert len(pages) == 3 and max(page.offset for page in pages) < min(first) and first == sorted(first)[::-1]


def test_the_cogeo_validator_agrees(patchy):
    cogeo = pytest.importorskip("rio_cogeo.cogeo")
    assert cogeo.cog_validate(str(patchy[0]), quiet=True)[:2] == (True, [])


@pytest.fixture
def site():
    """Known: cells -10 to 29 along x, 50 to 85 along y, but for one."""
    made, emap = SiteMap(0.1, channels={"rgb": "color"}), robots([(-10, 50)])
    emap.state.validity[0, 3, 30] = False
    made.merge(emap, time=1_780_000_000.75)
    return made


def test_every_pixel_lies_where_the_site_has_it(site, tmp_path):
    site.export(tmp_path / "site.tif", ["elevation", "variance"], **PLACE)
    with rasterio.open(tmp_path / "site.tif") as dataset:
        assert dataset.crs.to_epsg() == 32632 and dataset.shape == (36, 40) and dataset.dtypes == ("float32",) * 2
        rows, columns = np.indices(dataset.shape).reshape(2, -1)
        x, y = (np.asarray(part) for part in dataset.xy(rows, columns))
        values = dataset.read().reshape(2, -1)
        xy = torch.from_numpy(np.stack([x - 465_000.0, y - 5_247_000.0], 1))
        for band, name in enumerate(("elevation", "variance")):
            expected, known = site.sample(xy, name, mode="nearest")
            np.testing.assert_array_equal(np.isfinite(values[band]), known)
            np.testing.assert_array_equal(values[band][known], expected[known])
        assert (~np.isfinite(values[0])).sum() == 1


def test_bands_have_names_and_colours(site, tmp_path):
    site.export(tmp_path / "site.tif", ["elevation", "rgb"])
    with rasterio.open(tmp_path / "site.tif") as dataset:
        assert dataset.descriptions == ("elevation", "rgb.red", "rgb.green", "rgb.blue") and dataset.crs is None
        assert [role.name for role in dataset.colorinterp[1:]] == ["red", "green", "blue"]
        assert all(np.isnan(value) for value in dataset.nodatavals)
        assert dataset.transform.to_gdal() == pytest.approx((-1.0, 0.1, 0.0, 8.6, 0.0, -0.1))


@pytest.mark.slow(1)
def test_xarray_reads_it(site, tmp_path):
    rioxarray = pytest.importorskip("rioxarray")
    site.export(tmp_path / "site.tif", **PLACE)
    with rioxarray.open_rasterio(tmp_path / "site.tif", masked=True) as read:
        assert read.rio.crs.to_epsg() == 32632 and int(read.isnull().sum()) == 1
        value = float(read.sel(x=465_001.03, y=5_247_006.27, method="nearest")[0])
    assert value == pytest.approx(float(site.sample(torch.tensor([[1.03, 6.27]]), mode="nearest")[0]), abs=1e-6)


def test_version_and_date(site, tmp_path):
    site.merge(robots([(0, 50)]), time=1_780_000_100.75)
    site.export(tmp_path / "site.tif")
    with rasterio.open(tmp_path / "site.tif") as dataset:
        tags = dataset.tags()
    assert tags["TIFFTAG_DATETIME"] == "2026:05:28 20:28:20" and tags["TIFFTAG_SOFTWARE"] == "torchelev"
    assert tags["SITE_VERSION"] == site.version == "2" and float(tags["SITE_TIME"]) == 1_780_000_100.75


@pytest.mark.parametrize("time", [0.0, 5.0, 9.9e8, -1e9, 3e11])
def test_no_date_on_a_clock_that_does_not_count_from_1970(time):
    assert Moment("1", time).date is None


def test_the_first_second_that_has_a_date():
    assert Moment("1", 1e9).date == "2001:09:09 01:46:40"


def test_a_failure_of_gdal_leaves_the_older_file(site, tmp_path, monkeypatch):
    site.export(tmp_path / "a.tif")
    before = (tmp_path / "a.tif").read_bytes()

    def fail(source, target, **options):
        with open(target, "wb") as file:
            file.write(b"half")
        raise SystemError("Unknown GDAL Error")

    monkeypatch.setattr(rasterio_shutil, "copy", fail)
    with pytest.raises(OSError, match=r"a\.tif: cannot be written \(GDAL: Unknown GDAL Error\)"):
        site.export(tmp_path / "a.tif")
    assert (tmp_path / "a.tif").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


@pytest.mark.slow(4)
@pytest.mark.parametrize("share", [0.3, 0.7, 0.8, 0.9, 0.96, 0.97, 0.98, 0.999])
def test_a_full_disk_leaves_the_older_file(tmp_path, share):
    """A limit of the file's size that GDAL meets in the pixels, the overviews, where it is silent, or the copy."""
    resource = pytest.importorskip("resource")
    layers = np.random.default_rng(0).normal(100.0, 5.0, (1, 900, 900)).astype(np.float32)
    about = Bands(("elevation",), (900, 900), 0.1, (0.0, 0.0), None, {})
    write_cog(tmp_path / "whole.tif", blocks_of(layers), about)
    (tmp_path / "a.tif").write_bytes(b"older")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * (tmp_path / "whole.tif").stat().st_size), limits[1]))
    try:
        with pytest.raises(OSError, match=r"a\.tif: cannot be written \(.*\); an older file is left as it was$"):
            write_cog(tmp_path / "a.tif", blocks_of(layers), about)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (tmp_path / "a.tif").read_bytes() == b"older" and len(list(tmp_path.iterdir())) == 2


def test_the_package_that_is_missing_is_named(site, tmp_path, monkeypatch):
    without(monkeypatch, "rasterio")
    with pytest.raises(ModuleNotFoundError, match=r"\.tif needs rasterio: pip install \"torchelev\[geo\]\""):
        site.export(tmp_path / "a.tif")
    assert not list(tmp_path.iterdir())
