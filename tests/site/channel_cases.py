"""A site that keeps channels of every kind of fusion, and robots that see one of its cells."""

import numpy as np
import torch

from tests.helpers import pose, small_map
from torchelev import ChannelConfig
from torchelev.site.content.channels import SiteChannels
from torchelev.site.content.tiles import LAYERS
from torchelev.site.storage.engines import open_store
from torchelev.site.storage.store import TileStore

CELL = [0.05, 0.05]
NAMES, GRASS, STONE = ("grass", "stone"), (1.0, 0.0), (0.0, 1.0)
CHANNELS = {
    "heat": "mean",
    "alarm": "maximum",
    "terrain": ChannelConfig(kind="class", names=("grass", "stone")),
    "wet": ChannelConfig(kind="exponential", rate=1.0),
    "door": ChannelConfig(kind="class_average", names=("open", "shut"), rate=1.0),
}


def robot(**channels):
    return small_map(channels=channels or CHANNELS)


def see(emap, height=0.0, times=1, dt=0.1, **features):
    """Let a robot see one point of a height [m], with features, so many times."""
    cloud = torch.tensor([[[*CELL, height - 1.0]]])
    for _ in range(times):
        values = {name: torch.tensor(value).view(1, 1, -1) for name, value in features.items()}
        emap.update(cloud, pose(), pose(), dt=dt, features=values)


def value(site, layer):
    values, valid = site.sample(torch.tensor([CELL]), layer, mode="nearest")
    return float(values[0]) if valid[0] else None


def counts(site):
    """Points that the site holds of grass, and of stone; the prior is one point of both together."""
    weight = stored(site, "terrain/weight")
    return None if np.isnan(weight) else [round(value(site, f"terrain.{n}") * (weight + 1) - 0.5, 3) for n in NAMES]


def stored(site, layer):
    """A layer of the tiles, at the cell."""
    row, tile = site._tiles.layers.index(layer), site._tiles.read([(0, 0)])
    return float(tile[row, 0, 0, 0])


def stored_layers(path):
    return list(open_store(path, read_only=True).layers)


def folder_without(path):
    """A folder of a site that does not say since when its cells hold what they do."""
    channels = SiteChannels(CHANNELS, LAYERS)
    layers = (*LAYERS, *(layer for name in CHANNELS for layer in channels.sources(name)))
    attributes = {"resolution": 0.1, "channels": channels.attributes}
    TileStore.create(path, layers=layers, tile_size=64, attributes=attributes).close()
    return path
