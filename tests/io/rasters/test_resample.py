"""The rule by which pixels become cells, against loops over pixels and SciPy's interpolation."""

from collections import defaultdict

import numpy as np
import pytest

rasterio = pytest.importorskip("rasterio")

from scipy.interpolate import RegularGridInterpolator  # noqa: E402

from tests.io.rasters.files import place, turned, write_tif  # noqa: E402
from torchelev.io.rasters import Raster  # noqa: E402
from torchelev.io.rasters import pixels as pixels_module  # noqa: E402

CORNER, SIZE, CELL = (-7, 11), (50, 46), 0.1
X, Y = CORNER[0] * CELL, (CORNER[1] + SIZE[1]) * CELL  # the north-west corner of the cells


def pixel_values(shape, unknown=0.1, seed=0):
    rng = np.random.default_rng(seed)
    return np.where(rng.random(shape) < unknown, np.nan, rng.normal(50.0, 2.0, shape)).astype(np.float32)


def mean_by_loops(values, transform):
    """The mean of the known pixels whose centres lie in each cell, and the cells that hold centres."""
    found, held = defaultdict(list), set()
    for row, column in np.ndindex(*values.shape):
        x, y = place(transform, column + 0.5, row + 0.5)
        cell = int(np.floor(x / CELL + 1e-9)) - CORNER[0], int(np.floor(y / CELL + 1e-9)) - CORNER[1]
        if 0 <= cell[0] < SIZE[0] and 0 <= cell[1] < SIZE[1]:
            held.add(cell)
            if np.isfinite(values[row, column]):
                found[cell].append(float(values[row, column]))
    means = np.full(SIZE, np.nan)
    for cell, heights in found.items():
        means[cell] = np.mean(heights)
    return means, held


def bilinear_by_scipy(values, transform):
    """Bilinear interpolation at the cells' centres; NaN beyond the outer pixels' centres, or beside unknown ones."""
    i, j = np.indices(SIZE)
    x, y = (CORNER[0] + i + 0.5) * CELL, (CORNER[1] + j + 0.5) * CELL
    column, row = place(~transform, x, y)
    axes = [np.arange(n) + 0.5 for n in values.shape]
    read = RegularGridInterpolator(axes, values.astype(float), bounds_error=False, fill_value=np.nan)
    return read(np.stack([row, column], -1))


def compare(actual, expected):
    np.testing.assert_array_equal(np.isfinite(actual), np.isfinite(expected))
    np.testing.assert_allclose(actual, expected, rtol=2e-7)
    assert 0.02 < np.isfinite(actual).mean() < 0.98


@pytest.mark.parametrize(("side", "shape"), [(0.05, (60, 70)), (0.033, (90, 100)), (0.08, (30, 40))])
def test_smaller_pixels_are_averaged(tmp_path, monkeypatch, side, shape):
    values, transform = pixel_values(shape, unknown=0.6), turned(0.0, side, (X + 0.513, Y - 0.327))
    raster = Raster.open(write_tif(tmp_path / "a.tif", values, transform, nodata=np.nan))
    expected, held = mean_by_loops(values, transform)
    assert len(held) > np.isfinite(expected).sum()  # some cells hold unknown pixels alone
    compare(raster.heights(CORNER, SIZE, CELL), expected)
    monkeypatch.setattr(pixels_module, "_CHUNK", 100)  # the same in many reads
    compare(raster.heights(CORNER, SIZE, CELL), expected)


@pytest.mark.parametrize("angle", [30.0, 45.0, -100.0])
def test_turned_smaller_pixels_leave_no_holes(tmp_path, angle):
    """Of pixels turned by 45 degrees, some cells hold no centre: these are interpolated."""
    values, transform = pixel_values((40, 44), unknown=0.02), turned(angle, 0.09, (X + 2.0, Y - 2.0))
    expected, held = mean_by_loops(values, transform)
    between = bilinear_by_scipy(values, transform)
    holes = [cell for cell in np.ndindex(*SIZE) if cell not in held]
    assert sum(np.isfinite(between[cell]) for cell in holes) > 1
    for cell in holes:
        expected[cell] = between[cell]
    compare(Raster.open(write_tif(tmp_path / "a.tif", values, transform)).heights(CORNER, SIZE, CELL), expected)


@pytest.mark.parametrize(("side", "aspect"), [(0.25, 1.0), (0.17, 1.6), (0.1, 1.0), (0.06, 2.0)])
@pytest.mark.parametrize("angle", [0.0, 25.0, 180.0])
def test_larger_pixels_are_interpolated(tmp_path, side, aspect, angle):
    values, transform = pixel_values((20, 24), unknown=0.05), turned(angle, side, (X + 1.513, Y - 1.327), aspect)
    raster = Raster.open(write_tif(tmp_path / "a.tif", values, transform))
    compare(raster.heights(CORNER, SIZE, CELL), bilinear_by_scipy(values, transform))


def test_pixels_that_are_cells_keep_every_bit(tmp_path):
    values = pixel_values((SIZE[1], SIZE[0]), unknown=0.3)
    raster = Raster.open(write_tif(tmp_path / "a.tif", values, turned(0.0, CELL, (X, Y))))
    np.testing.assert_array_equal(raster.heights(CORNER, SIZE, CELL), values[::-1].T)


@pytest.mark.parametrize("start", [0, -40, 70])
def test_a_centre_on_a_border_belongs_to_the_larger_number(tmp_path, start):
    """Pixels of a third of a cell, of which every third one has its centre on the border of two cells."""
    values, side = np.arange(180, dtype=np.float32)[None].repeat(3, 0), 0.1 / 3
    raster = Raster.open(write_tif(tmp_path / "a.tif", values, turned(0.0, side, (start * 0.1 - side / 2, 0.1))))
    heights = raster.heights((start, 0), (60, 1), 0.1)[:, 0]
    np.testing.assert_allclose(heights, 3 * np.arange(60) + 1)  # columns 3 k to 3 k + 2


def test_nothing_is_extrapolated(tmp_path):
    """Two by two pixels of 1 m: known between their centres, 0.5 to 1.5 m, alone."""
    raster = Raster.open(write_tif(tmp_path / "a.tif", np.ones((2, 2), np.float32), turned(0.0, 1.0, (0.0, 2.0))))
    known = np.isfinite(raster.heights((0, 0), (20, 20), 0.1))
    assert np.argwhere(known).min() == 5 and np.argwhere(known).max() == 14 and known.sum() == 100


def test_far_from_the_origin_millimetres_count(tmp_path):
    """At UTM coordinates, on a slope of 45 degrees."""
    row, column = np.indices((40, 40))
    values = (0.5 * (column + 0.5)).astype(np.float32)
    raster = Raster.open(
        write_tif(tmp_path / "a.tif", values, turned(0.0, 0.5, (465_000.3, 5_247_020.0))),
        origin=(465_000.0, 5_247_000.0),
    )
    heights = raster.heights((20, 20), (50, 50), 0.1)
    x = (20.5 + np.arange(50)) * 0.1
    np.testing.assert_allclose(heights, np.repeat((x - 0.3)[:, None], 50, 1), atol=1e-5)
