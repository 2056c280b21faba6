"""Rasters as prior ground of a site: fused once, overridden by robots, all or nothing."""

import signal

import numpy as np
import pytest
import torch

from tests.site.helpers import known_cells, limits, robots
from torchelev import LevelsConfig
from torchelev.site import SiteConfig, SiteMap
from torchelev.site.rasters import merge_raster as merging
from torchelev.site.rasters.merge_raster import Box

rasterio = pytest.importorskip("rasterio")

from tests.io.rasters.files import turned, write_tif  # noqa: E402
from torchelev.io.rasters import Raster  # noqa: E402
from torchelev.io.rasters.gdal_pixels import GdalPixels  # noqa: E402


@pytest.fixture
def slope(tmp_path):
    """A raster of 8 x 6 m in pixels of 0.1 m: z = 0.2 x + 1, unknown where 3 < x < 4 and y > 5."""
    row, column = np.indices((60, 80))
    heights = (0.02 * (column + 0.5) + 1.0).astype(np.float32)
    heights[(row < 10) & (column >= 30) & (column < 40)] = -9999.0
    return write_tif(tmp_path / "slope.tif", heights, turned(0.0, 0.1, (0.0, 6.0)), nodata=-9999.0)


@pytest.fixture(params=["in memory", "on disk"])
def path(request, tmp_path):
    if request.param == "in memory":
        return None
    pytest.importorskip("tensorstore")
    return tmp_path / "site"


def state_of(site):
    """Everything that a site says."""
    cells = {name: known_cells(site, name) for name in ("elevation", "variance", "other_elevation", "time")}
    return cells, len(site), site.time, site.version, site.rasters


def test_all_known_cells_come_with_the_variance(slope, path):
    site = SiteMap(0.1, path)
    report = site.import_raster(slope, variance=0.04)
    heights, variance = known_cells(site), known_cells(site, "variance")
    assert (
        report == (4800 - 100, 0) and len(heights) == 4700 and (path is None or "raster" in site.versions()[0].message)
    )
    for (i, j), height in heights.items():
        assert 0 <= i < 80 and 0 <= j < 60 and not (30 <= i < 40 and j >= 50)
        assert height == pytest.approx(0.02 * (i + 0.5) + 1.0, abs=1e-6)
    assert set(variance.values()) == {np.float32(0.04)}
    if path is not None:
        site.close()
        opened = SiteMap.open(path, read_only=True)
        assert known_cells(opened) == heights and opened.rasters == site.rasters
        assert opened.rasters[0]["name"] == str(slope) and opened.rasters[0]["cells"] == [0, 0, 80, 60]


def test_a_large_raster_comes_in_many_parts(slope, monkeypatch):
    """The same cells if they are merged 64 by 64, and the same slopes at the borders between parts."""
    whole, parts = SiteMap(0.1), SiteMap(0.1)
    whole.import_raster(slope, origin=(3.1, 2.9))
    monkeypatch.setattr(merging, "_BLOCK", 64)
    windows = []
    read = merging.RasterCells.read
    monkeypatch.setattr(merging.RasterCells, "read", lambda self, box: windows.append(read(self, box)) or windows[-1])
    assert parts.import_raster(slope, origin=(3.1, 2.9)).cells == 4700
    assert state_of(parts)[0] == state_of(whole)[0] and len(windows) == 4 == len(parts)
    for window in windows:
        inner = window.gradient_x[window.has_normal]
        torch.testing.assert_close(inner, torch.full_like(inner, 0.2), atol=1e-4, rtol=0)
    assert sum(int(window.has_normal.sum()) for window in windows) == 78 * 58 - 10 * 9 - 2 * 9 - 10


def test_origin_height_and_area(slope):
    site = SiteMap(0.1)
    report = site.import_raster(slope, origin=(1.0, 2.0), height=1.0, area=(0.95, 2.0, -5.0, 1.0))
    cells = known_cells(site)
    assert report.cells == len(cells) == 11 * 30
    assert min(cells) == (9, -20) and max(cells) == (19, 9)
    assert cells[9, 0] == pytest.approx(0.02 * 19.5, abs=1e-6)


def test_robots_override_it_whether_they_come_before_or_after(slope):
    """0.5 m above it, they contradict; 5 cm above it, they are averaged with it, by information."""
    for above, shown in ((0.5, 0.5), (0.05, 0.05 * (1 - 1 / 901))):
        for is_first in (True, False):
            site, emap = SiteMap(0.1), robots([(20, 10)], heights=lambda x, y, a=above: 0.2 * x + 1.0 + a)
            if is_first:
                site.merge(emap, align=False, time=100.0)
            report = site.import_raster(slope)
            if not is_first:
                site.merge(emap, align=False, time=100.0)
            error = [
                height - 0.02 * (i + 0.5) - 1 for (i, j), height in known_cells(site).items() if i >= 20 and j >= 10
            ]
            own = [value for value in error if value > 0.01]
            assert len(own) == 40 * 36 and own == pytest.approx([shown] * len(own), abs=1e-4)
            assert len(known_cells(site, "other_elevation")) == (40 * 36 if above == 0.5 else 0)
            assert report.contradictions == (40 * 36 if above == 0.5 and is_first else 0)


def test_what_robots_have_measured_keeps_its_certainty(slope):
    site = SiteMap(0.1)
    site.merge(robots([(20, 10)], heights=lambda x, y: 0.2 * x + 1.0))
    site.import_raster(slope)
    low, high = limits(site, "variance")
    assert low == pytest.approx(1 / (1 / 1e-4 + 1 / 0.09), rel=1e-4) and high == np.float32(0.09)


def test_a_raster_that_comes_first_fixes_the_height_of_the_site(slope):
    """Two robots that overlap the raster and each other, 1 m too high and 5 cm apart."""
    site = SiteMap(0.1)
    site.import_raster(slope)
    emap = robots([(10, 10), (30, 10)], heights=lambda x, y: 0.2 * x + 2.0, offsets=[0.0, 0.05])
    report = site.merge(emap)
    assert report.offsets.tolist() == pytest.approx([1.0, 1.05], abs=2e-3) and not report.is_isolated.any()
    error = [height - 0.02 * (i + 0.5) - 1 for (i, _), height in known_cells(site).items()]
    assert max(map(abs, error)) < 2e-3 and known_cells(site, "other_elevation") == {}


def test_times(slope):
    """Without a time, the raster is as old as the first merge, also one that comes later; with one, it ages from it."""
    cfg = SiteConfig(variance_rate=1e-4)
    site = SiteMap(0.1, cfg=cfg)
    site.import_raster(slope)
    assert site.time == 0.0
    site.merge(robots([(200, 200)]), time=1.7e9)
    assert site.time == 1.7e9 and limits(site, "time") == [0.0, 0.0]
    site.merge(robots([(200, 200)]), time=1.7e9 + 100)
    assert limits(site, "time") == [0.0, 100.0] and limits(site, "variance")[1] == pytest.approx(0.09 + 0.01)
    dated = SiteMap(0.1, cfg=cfg)
    dated.import_raster(slope, time=1.7e9)
    dated.merge(robots([(200, 200)]), time=1.7e9 + 50)
    assert dated.time == 1.7e9 + 50 and limits(dated, "time") == [0.0, 50.0]
    older = SiteMap(0.1, cfg=cfg)
    older.merge(robots([(200, 200)]), time=1.7e9)
    older.import_raster(slope, time=1.7e9 - 30)
    assert older.time == 1.7e9 and limits(older, "time") == [0.0, 30.0]
    assert limits(older, "variance")[1] == pytest.approx(0.093)


def test_an_undated_raster_on_disk_waits_for_the_first_merge(slope, tmp_path):
    pytest.importorskip("tensorstore")
    with SiteMap(0.1, tmp_path / "site") as site:
        site.import_raster(slope)
    with SiteMap(0.1, tmp_path / "site") as site:
        site.merge(robots([(200, 200)]), time=1.7e9)
        assert site.time == 1.7e9
        with pytest.warns(RuntimeWarning, match="time: must be on the clock"):
            site.merge(robots([(200, 200)]), time=5.0)


@pytest.mark.slow(1)
def test_twice_counts_once(slope, tmp_path, path):
    """Also as another file, in other blocks; other cells of it may follow."""
    site = SiteMap(0.1, path)
    site.import_raster(slope, area=(0.0, 4.0, 0.0, 6.0))
    before = state_of(site)
    with rasterio.open(slope) as dataset:
        values = dataset.read(1)
    values[values == -9999] = 77
    copy = write_tif(tmp_path / "copy.tif", values, turned(0.0, 0.1, (0.0, 6.0)), nodata=77.0, compress="lzw")
    if path is not None:
        site.close()
        site = SiteMap.open(path)
    for again in (slope, copy, Raster.open(slope, variance=1.0)):
        with pytest.raises(
            ValueError, match=r"raster: must not be imported twice.*slope\.tif again; leave it out; site"
        ):
            site.import_raster(again)
    assert state_of(site) == before
    assert site.import_raster(slope, area=(4.0, 8.0, 0.0, 6.0)).cells == 2400 and len(known_cells(site)) == 4700
    assert set(known_cells(site, "variance").values()) == {np.float32(0.09)}


class Interrupted(BaseException):
    """As KeyboardInterrupt, which pytest would take for its own."""


def test_other_rasters_may_overlap(slope, tmp_path):
    other = write_tif(tmp_path / "other.tif", np.full((10, 10), 1.1, np.float32), turned(0.0, 0.1, (0.0, 1.0)))
    site = SiteMap(0.1)
    site.import_raster(slope)
    assert site.import_raster(other).cells == 100
    assert len(site.rasters) == 2 and limits(site, "variance") == pytest.approx([0.045, 0.09])


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError, Interrupted])
def test_an_import_that_fails_changes_nothing(slope, path, monkeypatch, error):
    """At the third of four reads, when half of the tiles are written."""
    site = SiteMap(0.1, path)
    site.merge(robots([(-10, -10)]), time=100.0)
    before, known = state_of(site), site.import_raster
    monkeypatch.setattr(merging, "_BLOCK", 64)
    read, calls = merging.RasterCells.read, []

    def fail(self, box):
        calls.append(box)
        if len(calls) == 3:
            raise error
        return read(self, box)

    monkeypatch.setattr(merging.RasterCells, "read", fail)
    with pytest.raises(error):
        site.import_raster(slope, origin=(3.1, 2.9), time=50.0)
    assert len(calls) == 3 and state_of(site) == before
    if path is not None:
        assert state_of(SiteMap.open(path, read_only=True)) == before
    monkeypatch.undo()
    assert known(slope, origin=(3.1, 2.9)).cells == 4700


def test_ctrl_c_while_pixels_are_read_changes_nothing(slope, path, monkeypatch):
    site = SiteMap(0.1, path)
    version, read, calls = site.version, GdalPixels.read, []

    def press(self, part):
        calls.append(part)
        if len(calls) == 2:  # the first one is of the fingerprint
            signal.raise_signal(signal.SIGINT)
        return read(self, part)

    monkeypatch.setattr(GdalPixels, "read", press)
    with pytest.raises(KeyboardInterrupt):
        site.import_raster(slope)
    assert len(site) == 0 and site.version == version and site.rasters == []


def test_a_raster_in_memory_is_checked_as_files_are():
    site, heights = SiteMap(0.1), np.full((20, 30), 2.0)
    raster = Raster.of_layer(heights, (1.0, 1.5), 0.1, variance=0.01)
    assert site.import_raster(raster).cells == 600 and limits(site, "elevation") == [2.0, 2.0]
    with pytest.raises(ValueError, match="variance, height: must be left out for a Raster"):
        site.import_raster(raster, variance=1.0, height=2.0)


def test_channels_stay_where_the_ground_does(slope):
    site = SiteMap(0.1, channels={"rgb": "color"})
    site.import_raster(slope)
    assert len(known_cells(site)) == 4700 and known_cells(site, "rgb.red") == {}


def test_wrong_arguments_change_nothing(slope, tmp_path):
    site = SiteMap(0.1)
    site.merge(robots([(0, 0)]))
    before = state_of(site)
    degrees = write_tif(tmp_path / "a.tif", np.ones((4, 4), np.float32), turned(0, 1.0), crs="EPSG:4326")
    nothing = write_tif(tmp_path / "b.tif", np.ones((9, 9), np.float32), turned(0, 1.0), nodata=1.0)
    cases = [
        (degrees, {}, ValueError, "whose coordinates are degrees"),
        (nothing, {}, ValueError, r"b\.tif: must hold known heights in the area, got none; check area="),
        (slope, {"area": (50.0, 60.0, 0.0, 1.0)}, ValueError, r"area: must meet the raster, .*spans .* 0, 8, 0, 6 m"),
        (slope, {"area": (1.0, 0.0, 0.0, 1.0)}, ValueError, "area: expected x_min, x_max, y_min, y_max"),
        (slope, {"variance": 0.0}, ValueError, "variance: must be a positive number"),
        (slope, {"time": "now"}, TypeError, "time: must be a number of seconds"),
        (slope, {"epsg": 32633}, ValueError, "epsg: must be that of"),
        (slope, {"layer": "ground"}, KeyError, "layer: must be a band of"),
        (tmp_path / "no.tif", {}, FileNotFoundError, "raster: must be a file"),
        (5, {}, TypeError, "raster: must be a path or a Raster, got int"),
    ]
    for raster, settings, error, text in cases:
        with pytest.raises(error, match=text):
            site.import_raster(raster, **settings)
    assert state_of(site) == before


def test_sites_that_take_no_rasters(slope, tmp_path):
    kept = {"keyframes": dict(keyframes=True), "levels": dict(levels=LevelsConfig(max_levels=2))}
    for name, settings in kept.items():
        with pytest.raises(ValueError, match=f"site: must be a site without .* to import rasters, got one with {name}"):
            SiteMap(0.1, **settings).import_raster(slope)
    pytest.importorskip("tensorstore")
    with SiteMap(0.1, tmp_path / "site") as site:
        site.merge(robots([(0, 0)]))
        with pytest.raises(ValueError, match="site: must be open for writing, got a read-only site"):
            SiteMap.open(tmp_path / "site", read_only=True).import_raster(slope)
    with pytest.raises(ValueError, match="site: must be open, got a site after close"):
        site.import_raster(slope)


def test_blocks_of_a_box_share_no_tile_and_miss_no_cell():
    blocks = list(Box((-700, 3), (600, 520)).blocks())
    assert sum((b.end[0] - b.first[0]) * (b.end[1] - b.first[1]) for b in blocks) == 1300 * 517
    owners = {}
    for number, b in enumerate(blocks):
        for x in range(b.first[0], b.end[0]):
            for y in (b.first[1], b.end[1] - 1):
                assert owners.setdefault((x // 64, y // 64), number) == number
