"""The style: files come out in both formats, colours stay apart, the caller's settings stay."""

import base64
import io
import re

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from torchelev.viz import palette, style

IMAGE = re.compile(rb'base64,([^"]+)"')
RED, GREEN, BLUE = 0.2126, 0.7152, 0.0722  # of the luminance


@style.styled()
def draw(values):
    figure = style.make_figure(4, 3)
    ax = figure.subplots()
    ax.set_title("a title")
    style.draw_cells(ax, values, (0, 2, 0, 1), palette.HEIGHTS, vmin=0, vmax=1)
    return figure


@pytest.mark.slow(1)
def test_a_figure_is_always_the_same_file(tmp_path):
    for name in ("a.png", "b.png", "a.svg", "b.svg"):
        style.write(draw(np.ones((2, 1))), tmp_path / name)
    assert Image.open(tmp_path / "a.png").size[0] > 300
    assert (tmp_path / "a.svg").read_text().count("<svg") == 1
    for suffix in (".png", ".svg"):
        assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


@pytest.mark.slow(1)
def test_a_noisy_svg_stays_small_and_keeps_its_colours(tmp_path):
    figure = style.make_figure(4, 3)
    noise = np.random.default_rng(0).uniform(0, 1, (300, 240))
    noise[:30] = np.nan
    style.draw_cells(figure.subplots(), noise, (0, 2, 0, 1), palette.HEIGHTS)
    style.write(figure, tmp_path / "noise.svg")
    text, raw = (tmp_path / "noise.svg").read_bytes(), io.BytesIO()
    figure.savefig(raw, format="svg", dpi=100, bbox_inches="tight", pad_inches=0.1)
    small, large = (Image.open(io.BytesIO(base64.b64decode(IMAGE.search(svg)[1]))) for svg in (text, raw.getvalue()))
    assert small.mode == "P" and len(text) < 0.6 * len(raw.getvalue())
    assert (np.asarray(small.convert("RGBA")) == np.asarray(large)).all()


@pytest.mark.slow(1)
def test_other_endings_choose_their_format(tmp_path):
    for name, start in (("a", b"\x89PNG"), ("a.jpg", b"\xff\xd8"), ("a.pdf", b"%PDF")):
        style.write(draw(np.ones((2, 1))), tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(start)


def test_settings_hold_within_the_context_alone():
    before = matplotlib.rcParams["font.size"]
    with style.styled():
        assert matplotlib.rcParams["font.size"] == style.SETTINGS["font.size"] != before
    assert matplotlib.rcParams["font.size"] == before


def test_unknown_cells_are_grey_and_x_runs_right():
    figure = draw(np.array([[np.nan], [1.0]]))  # x is the first index
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    picture = np.asarray(Image.open(buffer).convert("RGB")) / 255
    for x, color in ((0.5, palette.UNKNOWN_COLOR), (1.5, matplotlib.colormaps[palette.HEIGHTS](1.0)[:3])):
        column, row = figure.axes[0].transData.transform((x, 0.5))
        np.testing.assert_allclose(picture[picture.shape[0] - 1 - int(row), int(column)], to_rgb(color), atol=0.02)


@pytest.mark.parametrize("name", [palette.HEIGHTS, palette.DEVIATIONS, palette.RATINGS])
def test_brightness_alone_tells_values_apart(name):
    colors = matplotlib.colormaps[name](np.linspace(0, 1, 64))[:, :3]
    assert (np.diff(colors @ [RED, GREEN, BLUE]) > 0).all()


def test_both_ends_of_the_map_of_errors_differ_in_blue_which_red_green_blind_readers_see():
    low, high = (matplotlib.colormaps[palette.ERRORS](value)[2] for value in (0.1, 0.9))
    assert abs(low - high) > 0.3


def test_a_palette_changes_no_colour_that_one_sees():
    ramps = np.stack(np.meshgrid(np.arange(256), np.arange(256), indexing="ij"), -1).astype(np.uint8)
    many = Image.fromarray(np.dstack([ramps, ramps[..., :1]]))  # 65,536 colours
    few = Image.fromarray(np.dstack([ramps // 16 * 16, np.zeros((256, 256), np.uint8)]))
    assert style._with_palette(many).mode == "RGB"
    small = style._with_palette(few)
    assert small.mode == "P"
    assert np.abs(np.asarray(small.convert("RGB")).astype(int) - np.asarray(few).astype(int)).max() <= 8
