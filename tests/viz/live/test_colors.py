"""Colours of layers and their legend."""

import numpy as np
import pytest

from torchelev import ChannelConfig
from torchelev.viz.live.colors import (
    Limits,
    channel_legend,
    choose_limits,
    colorize,
    colorize_channel,
    describe,
    legend,
    shown_layers,
)


def test_limits_stay_while_they_are_about_right():
    values = np.linspace(0, 1, 1001)
    before = choose_limits("elevation", values)
    assert before == pytest.approx((0.01, 0.99))
    assert choose_limits("elevation", values + 0.05, before) is before
    assert choose_limits("elevation", values + 0.2, before) == pytest.approx((0.21, 1.19))


def test_ratings_have_fixed_limits_and_others_survive_an_empty_map():
    assert choose_limits("traversability", np.array([0.4, 0.5])) == (0, 1)
    assert choose_limits("elevation", np.full((2, 2), np.nan)) == (0, 1)


def test_unknown_is_grey_and_the_ends_are_the_colour_maps():
    colors = colorize("elevation", np.array([np.nan, -5, 0, 1, 9]), Limits(0, 1))
    assert colors[0].tolist() == [217, 217, 217, 255]
    assert (colors[1] == colors[2]).all() and (colors[3] == colors[4]).all() and (colors[2] != colors[3]).any()


def test_the_legend_gives_numbers_and_the_unit():
    text = legend("elevation", Limits(-0.5, 1.5))
    assert all(word in text for word in ("elevation [m]", ">-0.500<", ">0.500<", ">1.50<"))


def test_the_variance_is_shown_as_a_standard_deviation():
    shown = shown_layers({"variance": np.array([0.04]), "time": np.array([2.0])})
    assert shown["standard deviation"] == 0.2 and "variance" not in shown
    assert describe("time", 2.0) == "2.00 s" and describe("time", np.nan) == "unknown"


def test_channels_have_true_colours_and_those_of_classes():
    rgb = np.array([[[1.0, np.nan]], [[0.5, np.nan]], [[0.0, np.nan]]])
    assert colorize_channel(ChannelConfig(kind="color"), rgb).tolist() == [[[255, 128, 0, 255], [217, 217, 217, 255]]]
    terrain = ChannelConfig(kind="class", names=("grass & moss", "stone", "mud"))
    parts = np.array([[[0.8, 0.1]], [[0.1, 0.1]], [[0.1, 0.8]]])
    colors = colorize_channel(terrain, parts)[0, :, :3].tolist()
    text = channel_legend("terrain", terrain, parts)
    assert colors[0] != colors[1]
    for name, (r, g, b) in zip(("grass &amp; moss", "mud"), colors, strict=True):
        assert f'rgb({r}, {g}, {b})"></span> {name}<' in text
    assert "stone" not in text and "most probable class" in text
    assert "rgb, as seen" in channel_legend("rgb", ChannelConfig(kind="color"), rgb)
