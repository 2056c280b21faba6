"""Each cell is the square of pixels that it should be, in the colour that it should have."""

import matplotlib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from torchelev.viz.picture import round_length, save_image

GREY, WHITE, BLACK = (217, 217, 217), (255, 255, 255), (0, 0, 0)


@pytest.fixture
def values():
    """4 cells along x, 3 along y."""
    values = np.arange(12.0).reshape(4, 3)
    values[1, 2] = np.nan
    return values


def read(path):
    return np.asarray(Image.open(path).convert("RGB"))


@pytest.mark.parametrize("scale", [1, 3])
def test_every_pixel_is_its_cells_colour(tmp_path, values, scale):
    save_image(tmp_path / "map.png", values, 0.1, vmin=2, vmax=9, scale=scale, scale_bar=False)
    picture = read(tmp_path / "map.png")
    assert picture.shape == (3 * scale, 4 * scale, 3)
    colors = matplotlib.colormaps["viridis"]
    for row in range(3 * scale):
        for column in range(4 * scale):
            value = values[column // scale, 2 - row // scale]  # x to the right, y up
            share = min(max((value - 2) / 7, 0.0), 1.0)
            expected = GREY if np.isnan(value) else colors(share, bytes=True)[:3]
            assert tuple(picture[row, column]) == tuple(expected), (row, column)


def test_a_known_corner(tmp_path):
    """The cell of the largest x and the smallest y is the lower right one."""
    values = np.full((8, 6), np.nan)
    values[-1, 0] = 1.0
    save_image(tmp_path / "map.png", values, 0.5, cmap="Reds", vmin=0, vmax=1, scale_bar=False)
    picture = read(tmp_path / "map.png")
    red, green, blue = picture[5, 7]
    assert red > 80 and green < 30 and blue < 30
    picture = picture.copy()
    picture[5, 7] = GREY
    assert (picture == GREY).all()


def black_run(picture):
    """The longest run of black pixels in any row."""
    longest = 0
    for row in (picture == BLACK).all(-1):
        run = 0
        for black in row:
            run = run + 1 if black else 0
            longest = max(longest, run)
    return longest


@pytest.mark.parametrize("cells, resolution, scale, pixels", [(60, 0.04, 4, 100), (100, 0.1, 1, 50), (30, 0.02, 5, 50)])
def test_the_scale_bar_is_as_long_as_it_says(tmp_path, cells, resolution, scale, pixels):
    """2.4 m: 1 m of 25 cells at 4 pixels; 10 m: 5 m of 50 cells; 0.6 m: 0.2 m of 10 cells at 5 pixels."""
    save_image(tmp_path / "map.png", np.ones((cells, 20)), resolution, scale=scale, vmin=0, vmax=1)
    picture = read(tmp_path / "map.png")
    assert black_run(picture[20 * scale :]) == pixels
    assert len(picture) > 20 * scale and (picture[-1] == WHITE).all()


def test_the_color_bar_has_the_colours_highest_at_the_top(tmp_path, values):
    plain, barred = tmp_path / "plain.png", tmp_path / "barred.png"
    settings = dict(vmin=0, vmax=11, scale=20)
    save_image(plain, values, 0.1, **settings, scale_bar=False)
    save_image(barred, values, 0.1, **settings, scale_bar=False, color_bar=True)
    plain, barred = read(plain), read(barred)
    np.testing.assert_array_equal(barred[:60, :80], plain)
    bar = barred[:, 80:][:, 10]
    np.testing.assert_array_equal(bar, matplotlib.colormaps["viridis"](np.linspace(1, 0, 60), bytes=True)[:, :3])
    text = barred[:, 80 + 6 + 12 :]
    assert (text[:20] == BLACK).all(-1).any() and (text[-20:] == BLACK).all(-1).any()
    assert not (text[25:35] < 255).any()


def test_limits_follow_the_values_less_strays(tmp_path):
    values = np.linspace(0, 1, 10_000).reshape(100, 100)
    values[0, 0] = 1e6
    save_image(tmp_path / "map.png", values, 0.1, scale_bar=False)
    picture = read(tmp_path / "map.png")
    middle = matplotlib.colormaps["viridis"](0.5, bytes=True)[:3]
    assert np.abs(picture[50, 50].astype(int) - middle).max() <= 3


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (3, 5)])
@pytest.mark.parametrize("known", [True, False])
def test_draws_small_and_unknown_maps(tmp_path, shape, known):
    save_image(tmp_path / "map.png", np.full(shape, 2.0 if known else np.nan), 0.04, color_bar=True)
    picture = read(tmp_path / "map.png")
    assert ((picture[: shape[1], : shape[0]] == GREY).all(-1) == (not known)).all()


@given(st.floats(1e-3, 1e4))
def test_round_lengths(longest):
    length = round_length(longest)
    steps = [step * 10.0**power for power in range(-5, 6) for step in (1, 2, 5)]
    assert min(abs(length - step) / step for step in steps) < 1e-12
    assert length <= longest * (1 + 1e-8) and min(step for step in steps if step > length * 1.01) > longest


def test_round_lengths_in_numbers():
    for longest, length in [(0.5, 0.5), (0.9, 0.5), (1.0, 1), (4.99, 2), (5, 5), (0.3, 0.2), (12, 10), (1000, 1000)]:
        assert round_length(longest) == pytest.approx(length)
    assert round_length(0.1 * 3 + 0.2 - 1e-17) == 0.5


def test_refuses_what_is_no_picture(tmp_path, values):
    path = tmp_path / "map.png"
    for bad in (values[None], values[0], values[:0]):
        with pytest.raises(ValueError, match=r"values: expected \(H, W\), got"):
            save_image(path, bad, 0.1)
    for settings, match in [
        (dict(resolution=0.0), "resolution: must be a positive number"),
        (dict(scale=0), "scale: must be a positive int, got 0"),
        (dict(scale=1.5), "scale: must be a positive int"),
        (dict(cmap="virdis"), "cmap: must name a colour map of matplotlib, got 'virdis'"),
        (dict(vmin=1.0, vmax=1.0), "vmin: must lie below vmax, got 1.0 and 1.0"),
    ]:
        with pytest.raises(ValueError, match=match):
            save_image(path, values, **{"resolution": 0.1, **settings})
    assert not path.exists()
