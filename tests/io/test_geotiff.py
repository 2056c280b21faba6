"""GeoTIFF: north up, at the right place, with the names of the bands."""

import re

import numpy as np
import pytest
import tifffile
import torch

from tests.helpers import mapped
from tests.io.test_grid_map import map_of
from torchelev import ChannelConfig, ElevationMap, ElevationMapConfig, GridConfig
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


def test_channels_become_bands(tmp_path):
    """Colours are marked as such; classes have their names; the southern row, j = 0, is the last of the image."""
    channels = {"rgb": "color", "terrain": ChannelConfig(kind="class", names=("grass", "stone"))}
    grid = GridConfig(resolution=0.5, length_x=1.0, length_y=1.5)
    emap = ElevationMap(ElevationMapConfig(grid=grid, channels=channels))
    T = torch.eye(4)[None]
    T[:, 2, 3] = 1.0
    features = {"rgb": torch.tensor([[[1.0, 0.5, 0.25]]]), "terrain": torch.tensor([[[0.0, 1.0]]])}
    emap.update(torch.tensor([[[-0.25, -0.5, -1.0]]]), T, T, dt=0.1, features=features)  # the cell 0, 0
    save_geotiff(tmp_path / "map.tif", emap, layers=("elevation", "rgb", "terrain.stone"))
    tags, bands = tags_of(tmp_path / "map.tif")
    np.testing.assert_allclose(bands[:, 2, 0], [0.0, 1.0, 0.5, 0.25, 0.75], atol=1e-6)  # (1 + 1/2) / (1 + 1)
    assert np.isfinite(bands[1:]).sum() == 4 and tags[42113] == "nan"
    for k, name in enumerate(("elevation", "rgb.red", "rgb.green", "rgb.blue", "terrain.stone")):
        assert f'<Item name="DESCRIPTION" sample="{k}" role="description">{name}</Item>' in tags[42112]
    roles = re.findall(r'name="COLORINTERP" sample="(\d)" role="colorinterp">(\w+)<', tags[42112])
    assert roles == [("1", "Red"), ("2", "Green"), ("3", "Blue")]


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
