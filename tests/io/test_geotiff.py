"""GeoTIFF: north up, at the right place, with the names of the bands."""

import numpy as np
import pytest
import tifffile

from tests.helpers import mapped
from tests.io.test_grid_map import map_of
from torchelev.io.geotiff import save_geotiff


def tags_of(path):
    with tifffile.TiffFile(path) as tiff:
        return {tag.code: tag.value for tag in tiff.pages[0].tags}, tiff.asarray()


def test_a_known_corner(tmp_path):
    """3 cells of 0.5 m along x from 10, 2 along y from 20: the first pixel is the cell at x = 10.25, y = 20.75."""
    heights = [[1.0, 2.0], [3.0, 4.0], [5.0, np.nan]]
    save_geotiff(
        tmp_path / "map.tif", map_of(heights, corner=(20, 40)), layers=("elevation",), epsg=32632, origin=(400, 500)
    )
    tags, image = tags_of(tmp_path / "map.tif")
    np.testing.assert_array_equal(image, [[2.0, 4.0, np.nan], [1.0, 3.0, 5.0]])
    assert tags[33550] == (0.5, 0.5, 0.0)
    assert tags[33922] == (0.0, 0.0, 0.0, 410.0, 521.0, 0.0)
    assert tags[34735] == (1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32632)
    assert tags[42113] == "nan" and '<Item name="DESCRIPTION" sample="0" role="description">elevation' in tags[42112]


def test_all_layers_become_bands(tmp_path):
    emap = mapped(num_envs=2)
    save_geotiff(tmp_path / "map.tif", emap, env=1)
    _, image = tags_of(tmp_path / "map.tif")
    assert image.dtype == np.float32 and len(image) == len(emap.layers)
    for band, name in zip(image, emap.layers, strict=True):
        np.testing.assert_array_equal(band[::-1].T, emap.layer(name)[1].numpy())


def test_wrong_arguments_write_nothing(tmp_path):
    with pytest.raises(KeyError):
        save_geotiff(tmp_path / "map.tif", mapped(), layers=("height",))
    with pytest.raises(ValueError, match="epsg: must be the code of a projected system"):
        save_geotiff(tmp_path / "map.tif", mapped(), epsg=5)
    assert not list(tmp_path.iterdir())


def test_no_coordinate_system_without_a_code(tmp_path):
    save_geotiff(tmp_path / "map.tif", mapped(), layers=("elevation",))
    with tifffile.TiffFile(tmp_path / "map.tif") as file:
        assert 34735 not in file.pages[0].tags and 33550 in file.pages[0].tags
