"""Colours of channels: true ones, the class that is most probable, and the legend of those that occur."""

import io

import numpy as np
from PIL import Image

from torchelev import ChannelConfig
from torchelev.viz.channels import channel_colors, class_colors, class_legend, most_probable, shown_channels
from torchelev.viz.plot import Panel, draw_layers
from torchelev.viz.style import small_png

TERRAIN = ChannelConfig(kind="class", names=("grass", "stone", "mud"))
NAN = np.nan
PARTS = np.array([[[0.7, 0.2, NAN]], [[0.2, 0.2, NAN]], [[0.1, 0.6, NAN]]])  # (C, 1, 3)


def test_the_most_probable_class():
    np.testing.assert_array_equal(most_probable(PARTS), [[0, 2, NAN]])
    colors = channel_colors(TERRAIN, PARTS)
    np.testing.assert_array_equal(colors[0, :2], class_colors(3)[[0, 2]])
    assert np.isnan(colors[0, 2]).all()
    assert list(class_legend(TERRAIN, PARTS)) == ["grass", "mud"], "stone is nowhere"
    assert list(class_legend(ChannelConfig(kind="class", size=3), PARTS)) == ["0", "2"]


def test_true_colours_stay_within_0_and_1():
    rgb = channel_colors(ChannelConfig(kind="color"), np.array([[[1.2, NAN]], [[0.5, NAN]], [[-0.1, NAN]]]))
    np.testing.assert_array_equal(rgb, [[[1.0, 0.5, 0.0], [NAN] * 3]])


def test_many_classes_have_different_colours():
    assert len(np.unique(class_colors(26), axis=0)) == 26 and class_colors(60).shape == (60, 3)


def test_channels_that_are_shown():
    channels = {"rgb": {"kind": "color"}, "heat": {"kind": "mean"}, "terrain": {"kind": "class", "size": 2}}
    layers = dict.fromkeys(["rgb.red", "rgb.green", "rgb.blue", "terrain.0"], np.zeros((1, 1)))
    assert list(shown_channels({"channels": channels}, layers)) == ["rgb"], "terrain lacks a class"
    assert shown_channels({}, layers) == {}


def test_a_panel_of_colours():
    """The first index is x, to the right; unknown cells are grey, and no colour bar belongs to colours."""
    values = np.full((2, 2, 3), NAN)
    values[1, 0] = [1.0, 0.0, 0.0]  # right, below
    panel = Panel(title="rgb", values=values, legend={"mud": (0.0, 0.0, 1.0)})
    figure = draw_layers([panel], extent=(0.0, 2.0, 0.0, 2.0))
    picture = np.array(Image.open(io.BytesIO(small_png(figure))).convert("RGB")).astype(int)
    y, x = np.nonzero((abs(picture - [255, 0, 0]) < 4).all(-1))
    grey_y, grey_x = np.nonzero((abs(picture - 217) < 4).all(-1))
    assert len(x) > 1000 and x.mean() > grey_x.mean() and y.mean() > grey_y.mean()
    assert 10 < (abs(picture - [0, 0, 255]) < 4).all(-1).sum() < len(x), "the legend"
