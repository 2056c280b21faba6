"""`torchelev site export` and `torchelev site import`."""

import numpy as np
import pytest

from tests.site.helpers import known_cells, robots
from torchelev.io.export import load_npz
from torchelev.site import SiteMap

rasterio = pytest.importorskip("rasterio")
pytest.importorskip("tensorstore")

from tests.io.rasters.files import turned, write_tif  # noqa: E402


@pytest.fixture
def site(tmp_path):
    """The folder of a site that is open for writing."""
    with SiteMap(0.1, tmp_path / "hill") as made:
        made.merge(robots([(0, 0)]))
        yield tmp_path / "hill"


def test_export_beside_the_writer(run, site, tmp_path):
    code, out, err = run("site", "export", site, "hill.tif", "--layer", "elevation", "--layer", "variance",
                         "--epsg", 32632, "--origin", 465000, 5247000)  # fmt: skip
    assert (code, out, err) == (0, "wrote hill.tif\n", "")
    with rasterio.open(tmp_path / "hill.tif") as dataset:
        assert dataset.descriptions == ("elevation", "variance") and dataset.crs.to_epsg() == 32632
        assert (
            dataset.bounds[:2] == (465000.0, 5247000.0)
            and dataset.tags()["SITE_VERSION"] == SiteMap.open(site, read_only=True).version
        )
    assert run("site", "export", site, "part.npz", "--area", 0, 1, 2, 3)[0] == 0
    saved = load_npz(tmp_path / "part.npz")
    assert saved.extent == pytest.approx((0, 1, 2, 3)) and list(saved.layers) == ["elevation"]


def test_a_version_is_exported_by_its_id_or_tag(run, site, tmp_path):
    before = SiteMap.open(site, read_only=True).version
    with SiteMap(0.1, site) as writer:
        writer.merge(robots([(100, 0)]))
        writer.tag("last")
    for version, is_wide in ((before, False), ("last", True)):
        assert run("site", "export", site, "a.npz", "--version", version)[0] == 0
        assert (load_npz(tmp_path / "a.npz").extent[1] > 8.0) == is_wide
    code, _, err = run("site", "export", site, "a.npz", "--version", "none")
    assert code == 2 and "version: must be the id or tag of a version, got 'none'" in err and err.count("\n") == 1


def test_import_into_a_new_site_and_again(run, tmp_path):
    heights = np.full((20, 30), 412.5, np.float32)
    raster = write_tif(tmp_path / "terrain.tif", heights, turned(0.0, 0.1, (465000.0, 5247002.0)))
    place = ("--origin", 465000, 5247000, "--height", 412)
    code, out, err = run("site", "import", "hill", "terrain.tif", *place)
    assert (code, out) == (2, "") and "hill: must be a folder, got a path where nothing is" in err
    settings = (*place, "--epsg", 32632, "--variance", 0.01, "--area", 0, 2, 0, 2)
    code, out, err = run("site", "import", "hill", "terrain.tif", "--resolution", 0.1, *settings)
    assert (code, err) == (0, "") and out == "400 cells of terrain.tif, of which 0 contradict what was there\n"
    site = SiteMap.open(tmp_path / "hill", read_only=True)
    assert set(known_cells(site).values()) == {0.5} and set(known_cells(site, "variance").values()) == {
        np.float32(0.01)
    }
    code, _, err = run("site", "import", "hill", raster, *place)
    assert code == 2 and err.startswith("Error: raster: must not be imported twice") and err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("export", "hill", "a.tif", "--layer", "height"), "layers: must be one of elevation"),
        (("export", "hill", "a.jpg"), "path: must end with .tif"),
        (("export", "none", "a.tif"), "must be a folder, got a path where nothing is"),
        (("import", "hill", "none.tif"), "raster: must be a file"),
        (("import", "new", "none.tif", "--resolution", 0.1), "raster: must be a file"),
        (("import", "hill", "none.npz"), "none.npz: "),
    ],
)
def test_bad_input_is_one_line(run, tmp_path, arguments, text):
    with SiteMap(0.1, tmp_path / "hill") as site:
        site.merge(robots([(0, 0)]))
        version = site.version
    code, out, err = run("site", *arguments)
    assert (code, out) == (2, "") and text in err and err.count("\n") == 1
    assert SiteMap.open(tmp_path / "hill").version == version and [file.name for file in tmp_path.iterdir()] == ["hill"]


@pytest.mark.parametrize("command", ["export", "import"])
def test_help_fits_a_terminal(run, command):
    code, out, _ = run("site", command, "--help")
    assert code == 0 and f"torchelev site {command} hill/" in out and max(map(len, out.splitlines())) <= 80
    line = next(line for line in run("site", "--help")[1].splitlines() if line.split()[:1] == [command])
    assert line.endswith(".") and not line.endswith("...")
