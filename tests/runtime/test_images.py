"""Images of the C library: the same bits as `MapImage`."""

import json

import numpy as np
import pytest
import torch

import torchelev as te
from tests.helpers import pose, random_clouds
from torchelev.runtime.bundle.groups import image_settings
from torchelev.runtime.library import CMap, LibraryError

IMAGES = {
    "default": te.MapImage(),
    "all": te.MapImage(
        layers=("variance", "upper_bound", "validity", "elevation", "traversability"), nominal_height=0.4
    ),
    "bound alone": te.MapImage(layers=("upper_bound",), length_x=0.5, mode="nearest", alignment="world"),
    "validity alone": te.MapImage(layers=("validity",), resolution=0.1, mode="minimum", offset=(0.3, -0.2)),
    "base": te.MapImage(alignment="base", length_y=0.4, resolution=0.08),
}


@pytest.fixture(scope="module")
def maps(library):
    """A map with gaps and uncertain poses, and the same in C."""
    cfg = te.ElevationMapConfig(grid=te.GridConfig(resolution=0.05, length_x=3.2, length_y=3.2))
    emap, found = te.ElevationMap(cfg), CMap(library, json.dumps(cfg.to_dict()))
    covariance = 1e-3 * np.eye(6)[None]
    for k in range(3):
        T = pose((0.1 * k, 0.0, 0.8), yaw=0.4 * k)
        points = random_clouds(np.random.default_rng(k), T, 500)
        emap.update(points, T, T, 0.1, pose_covariance=torch.from_numpy(covariance))
        found.update(points.numpy(), T.numpy(), T[0].numpy(), 0.1, pose_covariance=covariance)
    return emap, found


@pytest.mark.parametrize("name", IMAGES)
def test_images(maps, name):
    image, c_image = IMAGES[name], maps[1].image(json.dumps(image_settings(IMAGES[name])))
    for T in (pose((0.1, 0.2, 0.6), yaw=1.0, pitch=0.2), pose((-0.2, 0.1, 0.5), yaw=-2.0)):
        wanted = image(maps[0], T)[0].numpy()
        assert np.array_equal(c_image(T[0].numpy()), wanted) and wanted.any()


@pytest.mark.parametrize(
    "settings, words",
    [
        ('{"size": 3}', "image.size: must be one of length_x"),
        ('{"layers": ["height"]}', "image.layers: must be one of elevation"),
        ('{"layers": ["elevation", "elevation"]}', "must name each channel once"),
        ('{"channels": ["rgb"]}', "image.channels: needs Python"),
        ('{"layers": []}', "image.layers: must be some of"),
        ('{"length_x": 1.63}', "length_x: must be a whole number of times 0.05 m, got 32.6 times; try 1.65"),
        ('{"resolution": 0}', "resolution: must be a positive number"),
        ('{"offset": 1}', "image.offset: must be two numbers"),
        ('{"mode": "cubic"}', "image.mode: must be one of"),
        ('{"length_x": 3.2}', "pattern: must lie in the map at any heading"),
        ("[]", "image: must be a mapping, got list"),
    ],
)
def test_bad_settings_are_refused(maps, settings, words):
    with pytest.raises(LibraryError) as error:
        maps[1].image(settings)
    assert words in str(error.value)
