"""Files of rasters: their nodata, masks, units and coordinate systems, and what is refused."""

import copy

import numpy as np
import pytest
import torch

from tests.helpers import small_map, without
from tests.io.test_grid_map import map_of
from torchelev.io import read_grid_map, write_grid_map
from torchelev.io.export import save_npz
from torchelev.io.geotiff import save_geotiff

rasterio = pytest.importorskip("rasterio")

from tests.io.rasters.files import turned, write_tif  # noqa: E402
from torchelev.io.rasters import Raster  # noqa: E402

NORTH_UP = turned(0.0, 1.0, (0.0, 4.0))
GRID = np.arange(16.0).reshape(4, 4)
CELLS = (0, 0), (4, 4), 1.0
EXPECTED = GRID[::-1].T  # in the map's convention


def heights_of(path, **settings):
    return Raster.open(path, **settings).heights(*CELLS)


@pytest.mark.parametrize("dtype", ["int16", "uint8", "float32", "float64", "int32"])
def test_nodata_is_unknown(tmp_path, dtype):
    path = write_tif(tmp_path / "a.tif", GRID.astype(dtype), NORTH_UP, nodata=5)
    np.testing.assert_array_equal(heights_of(path), np.where(EXPECTED == 5, np.nan, EXPECTED))


def test_what_is_not_finite_is_unknown(tmp_path):
    values = GRID.astype(np.float32)
    values[0, :2] = np.nan, np.inf
    path = write_tif(tmp_path / "a.tif", values, NORTH_UP, nodata=-9999.0)
    np.testing.assert_array_equal(heights_of(path), np.where(EXPECTED < 2, np.nan, EXPECTED))


def test_scale_and_offset_apply_to_heights_and_not_to_nodata(tmp_path):
    path = write_tif(tmp_path / "a.tif", GRID.astype(np.int16), NORTH_UP, nodata=5, scale=0.01, offset=400.0)
    np.testing.assert_allclose(heights_of(path), np.where(EXPECTED == 5, np.nan, 400 + 0.01 * EXPECTED), rtol=1e-7)
    np.testing.assert_allclose(heights_of(path, height=400.0)[0], 0.01 * EXPECTED[0], atol=1e-5)


def test_masks_are_respected(tmp_path):
    path = write_tif(tmp_path / "a.tif", GRID.astype(np.float32), NORTH_UP, mask=GRID % 3 > 0)
    np.testing.assert_array_equal(heights_of(path), np.where(EXPECTED % 3 > 0, EXPECTED, np.nan))


def test_bands_by_number_and_by_name(tmp_path):
    path = write_tif(tmp_path / "a.tif", np.stack([GRID, GRID + 100]).astype(np.float32), NORTH_UP)
    with rasterio.open(path, "r+") as dataset:
        dataset.descriptions = ("surface", "ground")
    np.testing.assert_array_equal(heights_of(path), EXPECTED)
    np.testing.assert_array_equal(heights_of(path, band=2), EXPECTED + 100)
    np.testing.assert_array_equal(heights_of(path, layer="ground"), EXPECTED + 100)
    with pytest.raises(ValueError, match=r"band: must be from 1 to 2 for .*, got 3; bands are 1 surface, 2 ground"):
        Raster.open(path, band=3)
    with pytest.raises(KeyError, match="layer: must be a band of .*, got 'roof'; bands are 1 surface, 2 ground"):
        Raster.open(path, layer="roof")


def test_torchelevs_own_files_come_back(tmp_path):
    heights = [[1.0, 2.0], [3.0, 4.0], [5.0, np.nan]]
    emap = map_of(heights, corner=(20, 40))
    save_geotiff(tmp_path / "a.tif", emap, layers=("variance", "elevation"), epsg=32632, origin=(400, 500))
    save_npz(tmp_path / "a.npz", emap)
    write_grid_map(tmp_path / "a.mcap", emap)
    raster = Raster.open(tmp_path / "a.tif", layer="elevation", epsg=32632, origin=(400, 500))
    opened = [raster, Raster.open(tmp_path / "a.npz"), Raster.open(tmp_path / "a.mcap", layer="elevation")]
    recorded = read_grid_map(tmp_path / "a.mcap", "/elevation_map")
    opened.append(Raster.of_layer(recorded.layers["elevation"], recorded.center, recorded.resolution))
    for one in opened:
        np.testing.assert_array_equal(one.heights((20, 40), (3, 2), 0.5), heights)
        assert one.extent == pytest.approx((10.0, 11.5, 20.0, 21.0))
    shifted = Raster.open(tmp_path / "a.npz", origin=(5.0, 10.0))
    np.testing.assert_array_equal(shifted.heights((10, 20), (3, 2), 0.5), heights)


def test_the_same_heights_have_the_same_fingerprint(tmp_path):
    values = GRID.astype(np.float32)
    values[1, 1] = np.nan
    plain = write_tif(tmp_path / "a.tif", values, NORTH_UP)
    packed = write_tif(tmp_path / "b.tif", values, NORTH_UP, nodata=np.nan, compress="deflate", tiled=True)
    other = write_tif(tmp_path / "c.tif", values + 1, NORTH_UP)
    first, second, third = (Raster.open(path).fingerprint for path in (plain, packed, other))
    assert first == second != third


def test_coordinate_systems(tmp_path):
    values = GRID.astype(np.float32)
    with pytest.raises(ValueError, match=r"projected coordinate system, got EPSG:4326, whose .* degrees; reproject it"):
        Raster.open(write_tif(tmp_path / "a.tif", values, NORTH_UP, crs="EPSG:4326"))
    with pytest.raises(ValueError, match="must be in metres, got EPSG:2264, whose unit is US survey foot; reproject"):
        Raster.open(write_tif(tmp_path / "b.tif", values, NORTH_UP, crs="EPSG:2264"))
    right = write_tif(tmp_path / "c.tif", values, NORTH_UP, crs="EPSG:32632")
    with pytest.raises(ValueError, match=r"epsg: must be that of .*, EPSG:32632, got 32633; give that one"):
        Raster.open(right, epsg=32633)
    with pytest.raises(ValueError, match="epsg: must be the code of a projected system"):
        Raster.open(right, epsg=5)
    both = write_tif(tmp_path / "d.tif", values, NORTH_UP, crs="EPSG:25832+7837")  # with heights
    for path in (right, both, write_tif(tmp_path / "e.tif", values, NORTH_UP, crs=None)):
        np.testing.assert_array_equal(heights_of(path, epsg=25832 if path == both else 32632), EXPECTED)
    with pytest.raises(ValueError, match="epsg: must be that of"):
        Raster.open(both, epsg=32632)


def test_files_that_are_no_rasters(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match="raster: must be a file, got .*no.tif', where nothing is"):
        Raster.open(tmp_path / "no.tif")
    (tmp_path / "text.tif").write_text("not a raster")
    with pytest.raises(ValueError, match=r"text\.tif: must be a GeoTIFF or another raster that GDAL reads"):
        Raster.open(tmp_path / "text.tif")
    with pytest.raises(ValueError, match="must be georeferenced by an affine transform, got none"):
        with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
            write_tif(tmp_path / "a.tif", GRID.astype(np.float32), None, crs=None)
        Raster.open(tmp_path / "a.tif")
    with pytest.raises(ValueError, match="must hold real numbers, got complex64"):
        Raster.open(write_tif(tmp_path / "b.tif", GRID.astype(np.complex64), NORTH_UP))
    path = write_tif(tmp_path / "c.tif", GRID.astype(np.float32), NORTH_UP)
    with rasterio.open(path, "r+") as dataset:
        dataset.units = ["ft"]
    with pytest.raises(ValueError, match="must hold heights in metres, got a band in ft"):
        Raster.open(path)
    np.savez(tmp_path / "a.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match="not a map"):
        Raster.open(tmp_path / "a.npz")
    save_npz(tmp_path / "b.npz", small_map())
    with pytest.raises(KeyError, match="layer: must be one of .*b.npz, got 'height'; layers are elevation"):
        Raster.open(tmp_path / "b.npz", layer="height")
    for settings, text in (({"epsg": 32632}, "epsg: must be None"), ({"band": 2}, "band: must be left out")):
        with pytest.raises(ValueError, match=text):
            Raster.open(tmp_path / "b.npz", **settings)
    without(monkeypatch, "rasterio")
    with pytest.raises(ModuleNotFoundError, match=r'needs rasterio: pip install "torchelev\[geo\]"'):
        Raster.open(path)


def test_wrong_numbers(tmp_path):
    path = write_tif(tmp_path / "a.tif", GRID.astype(np.float32), NORTH_UP)
    for variance in (0.0, -1.0, float("nan"), "much"):
        with pytest.raises(ValueError, match="variance: must be a positive number"):
            Raster.open(path, variance=variance)
    with pytest.raises(ValueError, match="height: must be a finite number of metres"):
        Raster.open(path, height=float("inf"))
    with pytest.raises(ValueError, match="origin: expected easting and northing in metres"):
        Raster.open(path, origin=(0.0, float("nan")))
    with pytest.raises(ValueError, match=r"heights: expected \(H, W\) numbers, got \(3,\) float64"):
        Raster.of_layer(np.zeros(3), np.zeros(2), 0.1)


@pytest.mark.slow(1)
def test_a_map_begins_with_a_raster(tmp_path):
    """Unknown cells are filled with the raster's variance, known ones stay, and the first measurement prevails."""
    row, column = np.indices((60, 60))
    path = write_tif(tmp_path / "a.tif", (0.1 * column + 5.0).astype(np.float32), turned(0.0, 0.1, (-2.0, 4.0)))
    emap = small_map(2, cells=(12, 10))
    emap.state.validity[0, 3, 4], emap.state.elevation[0, 3, 4] = True, 7.0
    T = torch.eye(4).repeat(2, 1, 1)
    T[1, :2, 3] = torch.tensor([1.0, 2.0])
    emap.initialize_from(Raster.open(path, variance=0.04, height=5.0), T)
    x = emap.cell_centers()[..., 0]
    expected = 10 * 0.1 * (x + 2.0) - 0.05
    filled = torch.ones(2, 12, 10, dtype=torch.bool)
    filled[0, 3, 4] = False
    heights, variance = emap.layer("elevation"), emap.layer("variance")
    torch.testing.assert_close(heights[filled], expected[filled].float(), atol=1e-5, rtol=0)
    assert float(heights[0, 3, 4]) == 7.0 and torch.all(variance[filled] == 0.04)
    points = torch.tensor([[[0.05, 0.05, -1.5]] * 3] * 2)
    T[:, 2, 3] = 2.0
    emap.update(points, T, T, dt=0.1)
    found = emap.sample(torch.tensor([[[0.05, 0.05]], [[1.05, 2.05]]]), mode="nearest")[0]
    torch.testing.assert_close(found, torch.full((2, 1), 0.5), atol=0.02, rtol=0)


def test_a_map_begins_with_a_file(tmp_path):
    write_tif(tmp_path / "a.tif", np.full((40, 40), 3.0, np.float32), turned(0.0, 0.1, (-2.0, 2.0)))
    emap = small_map(2)
    emap.initialize_from(tmp_path / "a.tif", mask=torch.tensor([False, True]))
    assert not emap.layer("elevation")[0].isfinite().any() and (emap.layer("elevation")[1] == 3.0).all()
    emap.state.statistics.disagreement.fill_(0.3)  # which is part of variances, and taken out for a while
    before = copy.deepcopy(emap.state_dict())
    with pytest.raises(ValueError, match="variance: must be below fusion.max_variance, 1, got 2.0"):
        emap.initialize_from(Raster.open(tmp_path / "a.tif", variance=2.0))
    with pytest.raises(FileNotFoundError):
        emap.initialize_from(str(tmp_path / "no.tif"))
    assert all(torch.equal(value, before[name]) for name, value in emap.state_dict().items() if torch.is_tensor(value))
