"""Small maps for the tests of training and evaluation."""

import functools

import torch

from torchelev.robot import RobotConfig
from training.traversability.maps.data import MappedTerrain
from training.traversability.maps.mapping import DataConfig

TINY = functools.partial(
    DataConfig, num_maps=2, window=2.0, looks=(2, 2), headings=2, camera_pixels=(16, 12), lidar_rays=(8, 64)
)


def made_up(seed, num_maps=2, cells=14):
    """Maps of noise; what counts here is that they differ."""
    draw = functools.partial(torch.rand, num_maps, cells, cells, generator=torch.Generator().manual_seed(seed))
    layers = [0.3 * draw(), draw() < 0.8, 0.01 * draw(), draw(), draw() < 0.5]
    return MappedTerrain(*layers, draw(), draw() < 0.9, 0.1, RobotConfig(), ("rough",) * num_maps)
