"""Channels in files and messages: saved maps, layers of one environment, and packed colours."""

import numpy as np
import pytest
import torch

from torchelev import ChannelConfig, ElevationMap, ElevationMapConfig, FilterConfig, GridConfig
from torchelev.io import read_grid_map, write_grid_map
from torchelev.io.export import load_npz, save_npz, take
from torchelev.io.grid_map import from_grid_map, pack_colors, to_grid_map
from torchelev.io.map_file import load_map, save_map


@pytest.fixture
def emap():
    """Three maps whose cells have the colour and the number of their environment."""
    double = FilterConfig(layer="double", filter="expression", settings={"formula": "2 * number"})
    channels = {"rgb": "color", "number": ChannelConfig(), "dino": ChannelConfig(kind="feature", size=2)}
    cfg = ElevationMapConfig(
        grid=GridConfig(resolution=0.1, length_x=1.0, length_y=0.8), channels=channels, filters=(double,)
    )
    emap = ElevationMap(cfg, num_envs=3)
    points = torch.tensor([[[0.05, 0.05, -1.0]]]).repeat(3, 1, 1)
    T = torch.eye(4).repeat(3, 1, 1)
    T[:, 2, 3] = 1.0
    number = torch.tensor([[1.0], [2.0], [3.0]])
    rgb = torch.tensor([[[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.2]], [[0.0, 0.0, 1.0]]])
    emap.update(points, T, T, dt=0.1, features={"rgb": rgb, "number": number, "dino": torch.ones(3, 1, 2)})
    return emap


def test_a_saved_map_continues_with_its_channels(emap, tmp_path):
    save_map(tmp_path / "map.npz", emap)
    again = load_map(tmp_path / "map.npz", env_ids=[2, 0])
    assert again.layer("number").nan_to_num().amax((1, 2)).tolist() == [3.0, 1.0]
    assert again.layer("rgb").nan_to_num().amax((2, 3)).tolist() == [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    for name, value in emap.channels.named_buffers():
        torch.testing.assert_close(again.channels.get_buffer(name), value[[2, 0]], equal_nan=True)


def test_layers_of_one_environment_are_its_own(emap, tmp_path):
    assert np.nanmax(take(emap, 1).layers["number"]) == 2.0
    assert np.nanmax(take(emap, 2, ["double"]).layers["double"]) == 6.0
    save_npz(tmp_path / "map.npz", emap, env=1)
    assert np.nanmax(load_npz(tmp_path / "map.npz").layers["rgb.green"]) == 1.0
    assert load_map(tmp_path / "map.npz").layer("number").nan_to_num().max() == 2.0
    state = type(emap.state)(*(value[:1] for value in emap.state[:-1]), statistics=emap.state.statistics)
    with pytest.raises(ValueError, match="state: must be of all 3 maps, as channels and levels"):
        emap.layer("number", state=state)


def test_colours_of_a_grid_map_are_packed(emap):
    message = to_grid_map(emap, env=1, layers=("elevation", "rgb", "rgb.green"))
    layers = from_grid_map(message).layers
    assert list(layers) == ["elevation", "rgb", "rgb.green"]
    known = ~np.isnan(layers["rgb"])
    assert known.sum() == 1 and layers["rgb"][known].view(np.uint32)[0] == 0x00FF33
    with pytest.raises(
        ValueError, match="layers: must have one value for each cell, got 'dino' with 2; give dino.0, dino.1"
    ):
        to_grid_map(emap, layers=("dino",))


def test_a_recorded_map_has_packed_colours(emap, tmp_path):
    write_grid_map(tmp_path / "map.mcap", emap, env=1)
    layers = read_grid_map(tmp_path / "map.mcap").layers
    known = ~np.isnan(layers["rgb"])
    assert layers["rgb"][known].view(np.uint32).tolist() == [0x00FF33] and "rgb.green" in layers


def test_packed_colours_by_hand():
    rgb = np.array([[[1.0, 0.5, np.nan]], [[0.0, 0.25, 0.0]], [[1.0, 0.0, 0.0]]])
    packed = pack_colors(rgb)
    assert packed.view(np.uint32)[0, :2].tolist() == [0xFF00FF, 0x804000] and np.isnan(packed[0, 2])
