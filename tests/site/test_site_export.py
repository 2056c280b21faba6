"""Files of a site, read back by other programs' readers: at the right place, north up."""

import tracemalloc

import cv2
import numpy as np
import plyfile
import pytest
import tifffile

from tests.helpers import without
from tests.site.helpers import fill, robots
from torchelev.files.output_files import is_own_output
from torchelev.io.export import load_npz
from torchelev.site import SiteMap


@pytest.fixture
def site():
    """Known: cells -10 to 29 along x, 50 to 85 along y, but for one; heights encode the cell."""
    made = SiteMap(0.1)
    emap = robots([(-10, 50)], heights=lambda x, y: x + 0.01 * y)
    emap.state.validity[0, 3, 30] = False
    made.merge(emap)
    return made


def height(i, j):
    """The height of a cell, by its number on the lattice."""
    return (i + 0.5) * 0.1 + 0.01 * (j + 0.5) * 0.1


def batched(keys):
    """The GeoTIFF keys of a tag: four numbers each."""
    return list(zip(*(keys[k::4] for k in range(4)), strict=True))


def tags_of(path):
    with tifffile.TiffFile(path) as tiff:
        return {tag.code: tag.value for tag in tiff.pages[0].tags}, tiff.asarray()


def test_a_geotiff_has_north_up_and_lies_right(site, tmp_path):
    site.export(tmp_path / "site.tif", epsg=32632, origin=(400.0, 500.0))
    tags, image = tags_of(tmp_path / "site.tif")
    assert image.shape == (36, 40) and image.dtype == np.float32
    assert tags[33550] == (0.1, 0.1, 0.0) and (3072, 0, 1, 32632) in batched(tags[34735]) and tags[42113] == "nan"
    assert tags[33922] == pytest.approx((0, 0, 0, 399.0, 508.6, 0))
    row, column = np.indices(image.shape)
    expected = height(column - 10, 85 - row)
    assert np.argwhere(np.isnan(image)).tolist() == [[5, 3]]
    np.testing.assert_allclose(image[np.isfinite(image)], expected[np.isfinite(image)], atol=1e-5)


def test_a_geotiff_of_several_bands_and_blocks(tmp_path):
    site = SiteMap(0.1)
    site.merge(robots([(-300, 0), (300, 290)], cells=(300, 40), heights=lambda x, y: x + 0.01 * y))
    site.export(tmp_path / "site.tif", ("elevation", "variance"))
    tags, image = tags_of(tmp_path / "site.tif")
    assert image.shape == (2, 330, 900) and tags[33922][3:5] == pytest.approx((-30.0, 33.0))
    assert [name in tags[42112] for name in ("elevation", "variance", "time")] == [True, True, False]
    window = site.window((15.0, 16.5), 90.0, 33.0, ["elevation", "variance"]).layers
    for band, name in zip(image, window, strict=True):
        np.testing.assert_array_equal(band[::-1].T, window[name])


@pytest.mark.slow(1)
def test_memory_does_not_grow_with_the_area(tmp_path, monkeypatch):
    site, largest = SiteMap(0.1), []
    emap = robots([(0, 0), (3000, 3000)], heights=lambda x, y: 0 * x)
    site.merge(emap)
    copy = site._copy
    site._copy = lambda corner, size, names: (largest.append(size), copy(corner, size, names))[1]
    tracemalloc.start()
    site.export(tmp_path / "site.tif")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert set(largest) == {(256, 256)} and peak < 3000 * 3000
    assert tags_of(tmp_path / "site.tif")[1].shape == (3036, 3040)


def test_a_picture_lies_where_its_world_file_says(site, tmp_path):
    site.export(tmp_path / "site.png", origin=(400.0, 500.0))
    picture = cv2.imread(str(tmp_path / "site.png"), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (36, 40, 4)
    assert np.argwhere(picture[..., 3] == 0).tolist() == [[5, 3]]
    blue, green, red = picture[20, [0, 39], :3].astype(int).T
    assert green[0] < green[1] and red[0] < red[1]  # dark blue in the west, yellow in the east
    world = [float(line) for line in (tmp_path / "site.pgw").read_text().split()]
    assert world == pytest.approx([0.1, 0, 0, -0.1, 399.05, 508.55])
    text = (tmp_path / "site.png").read_bytes()[:300]
    assert f"elevation from {height(-10, 50):g} ".encode() in text and is_own_output(tmp_path / "site.png")


def test_slopes_towards_the_north_west_are_bright(tmp_path):
    brightness = []
    for sign in (1.0, -1.0):  # rising to the south-east, so that it faces north-west, and the other way round
        site = SiteMap(0.1)
        site.merge(robots([(0, 0)], cells=(40, 40), heights=lambda x, y, sign=sign: sign * (x - y)))
        site.export(tmp_path / "site.png")
        brightness.append(cv2.imread(str(tmp_path / "site.png"))[10:30, 10:30].mean())
    assert brightness[0] > 1.5 * brightness[1]


def test_a_mesh_is_in_the_map_frame(site, tmp_path):
    site.export(tmp_path / "site.ply")
    mesh = plyfile.PlyData.read(tmp_path / "site.ply")
    x, y, z = (mesh["vertex"][axis] for axis in "xyz")
    assert len(x) == 40 * 36 - 1 and len(mesh["face"].data) == 2 * (39 * 35 - 4)
    assert [x.min(), x.max(), y.min(), y.max()] == pytest.approx([-0.95, 2.95, 5.05, 8.55])
    np.testing.assert_allclose(z, x + 0.01 * y, atol=1e-5)


def test_arrays_are_those_of_save_npz(site, tmp_path):
    site.export(tmp_path / "site.npz", ("elevation", "time"), area=(-0.5, 1.02, 6.0, 7.0))
    saved = load_npz(tmp_path / "site.npz")
    assert saved.extent == pytest.approx((-0.5, 1.1, 6.0, 7.0)) and list(saved.layers) == ["elevation", "time"]
    i, j = np.indices((16, 10))
    np.testing.assert_allclose(saved.layers["elevation"], height(i - 5, j + 60), atol=1e-5)


def test_the_area_ends_with_what_is_known(site, tmp_path):
    emap = fill(robots([(0, 0)]), [(200, 200)], known=0.0)
    emap.state.bounded.fill_(True)
    site.merge(emap)
    site.export(tmp_path / "a.npz")
    assert load_npz(tmp_path / "a.npz").extent == pytest.approx((-1.0, 3.0, 5.0, 8.6))
    site.export(tmp_path / "b.npz", ("upper_bound",))
    assert load_npz(tmp_path / "b.npz").extent == pytest.approx((-1.0, 24.0, 5.0, 23.6))


def test_wrong_arguments_write_nothing(site, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"path: must end with \.tif, \.png, \.ply, \.npz, got .*jpg"):
        site.export(tmp_path / "a.jpg")
    with pytest.raises(KeyError, match="layers: must be one of elevation, .*, got 'height'"):
        site.export(tmp_path / "a.tif", ("height",))
    with pytest.raises(TypeError, match=r"layers: must be a list of names, got 'time'; give \['time'\]"):
        site.export(tmp_path / "a.tif", "time")
    with pytest.raises(ValueError, match=r"layers: must be one for \.ply, got 2"):
        site.export(tmp_path / "a.ply", ("elevation", "time"))
    for area in ((1.0, 0.0, 0.0, 1.0), (0.0, 1.0, 0.0, float("nan")), (0.0, 1.0), ("a", 1.0, 0.0, 1.0), 5.0):
        with pytest.raises(
            ValueError, match=r"area: expected x_min, x_max, y_min, y_max in metres, got .*; see site\."
        ):
            site.export(tmp_path / "a.tif", area=area)
    with pytest.raises(ValueError, match=r"area: must be of at most 16000000 cells for \.ply, got 10000 x 2000 cells"):
        site.export(tmp_path / "a.ply", area=(0.0, 1000.0, 0.0, 200.0))
    with pytest.raises(ValueError, match=r"1000 x 1000 m; give an area such as 819\.2 x 819\.2 m, or write \.tif"):
        site.export(tmp_path / "a.png", area=(0.0, 1000.0, 0.0, 1000.0))
    with pytest.raises(ValueError, match="area: must hold known cells"):
        site.export(tmp_path / "a.png", area=(100.0, 101.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="epsg: must be the code"):
        site.export(tmp_path / "a.tif", epsg=5)
    with pytest.raises(ValueError, match="epsg: must be None"):
        site.export(tmp_path / "a.png", epsg=32632)
    with pytest.raises(ValueError, match="origin: must be"):
        site.export(tmp_path / "a.ply", origin=(1.0, 0.0))
    text = "site: must have known cells to export, got none of"
    with pytest.raises(ValueError, match=f"{text} elevation, time; merge a map that has measured first"):
        SiteMap(0.1).export(tmp_path / "a.tif", ("elevation", "time"))
    with pytest.raises(ValueError, match=f"{text} other_elevation; choose other layers"):
        site.export(tmp_path / "a.tif", ("other_elevation",))
    without(monkeypatch, "tifffile")
    with pytest.raises(ModuleNotFoundError, match=r"\.tif needs tifffile: pip install \"torchelev\[geo\]\""):
        site.export(tmp_path / "a.tif")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", ["tif", "png", "ply", "npz"])
def test_a_place_where_no_file_can_be_is_named_as_it_was_given(site, tmp_path, monkeypatch, suffix):
    monkeypatch.chdir(tmp_path)
    text = rf"^no/such/z\.{suffix}: cannot be written \(there is no folder {tmp_path}/no/such: make it first\)"
    with pytest.raises(OSError, match=text):
        site.export(f"no/such/z.{suffix}")
    (tmp_path / f"folder.{suffix}").mkdir()
    with pytest.raises(OSError, match=rf"^folder\.{suffix}: cannot be written \(it is a folder\)"):
        site.export(f"folder.{suffix}")
    assert [file.name for file in tmp_path.rglob("*")] == [f"folder.{suffix}"]


def test_a_file_that_fails_leaves_the_older_one(site, tmp_path, monkeypatch):
    site.export(tmp_path / "a.tif")
    before = (tmp_path / "a.tif").read_bytes()

    def fail(file, *args, **kwargs):
        file.write(b"half")
        raise ZeroDivisionError

    monkeypatch.setattr(tifffile, "imwrite", fail)
    with pytest.raises(ZeroDivisionError):
        site.export(tmp_path / "a.tif")
    assert (tmp_path / "a.tif").read_bytes() == before and len(list(tmp_path.iterdir())) == 1
