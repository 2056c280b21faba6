"""The picture has the map the right way round."""

import io

import numpy as np
import pytest
from PIL import Image

from torchelev.viz.plot import Panel, draw_layers, save_layers
from torchelev.viz.style import MAX_BYTES

EXTENT = (-2.0, 2.0, 10.0, 13.0)


@pytest.fixture
def values():
    """4 x 3 m at 0.5 m, known in one corner alone: the largest x and the smallest y."""
    values = np.full((8, 6), np.nan)
    values[-1, 0] = 1.0
    return values


def pixel(figure, ax, x, y):
    """Colour (RGB) of the picture at map position x, y [m]."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    picture = np.asarray(Image.open(buffer).convert("RGB"))
    column, row = ax.transData.transform((x, y)) * 100 / figure.dpi
    return picture[picture.shape[0] - 1 - int(row), int(column)]


@pytest.mark.slow(1)
def test_corner_is_drawn_where_the_axes_say(values):
    figure = draw_layers(
        [Panel(title="elevation", values=values, unit="m", cmap="Reds", vmin=0, vmax=1)], extent=EXTENT
    )
    ax = figure.axes[0]
    figure.canvas.draw()
    left, right = ax.get_xlim()
    bottom, top = ax.get_ylim()
    assert (left, right, bottom, top) == EXTENT
    red, green, blue = pixel(figure, ax, 1.75, 10.25)
    assert red > 80 and green < 30 and blue < 30
    for x, y in [(1.75, 12.75), (-1.75, 10.25), (-1.75, 12.75), (1.25, 10.25), (1.75, 10.75)]:
        assert len(set(pixel(figure, ax, x, y))) == 1, "unknown cells are grey"


def test_axes_and_bars_carry_units(values):
    figure = draw_layers([Panel(title=f"layer {k}", values=values, unit="m^2") for k in range(6)], extent=EXTENT)
    labels = [text for ax in figure.axes for text in (ax.get_xlabel(), ax.get_ylabel()) if text]
    assert labels.count("x, map frame [m]") == 3 and labels.count("y, map frame [m]") == 2
    assert labels.count("[m^2]") == 6


@pytest.mark.slow(1)
def test_every_panel_count_fits(values, tmp_path):
    for count in range(1, 9):
        figure = draw_layers([Panel(title=str(k), values=values) for k in range(count)], extent=EXTENT)
        assert sum(ax.get_title() != "" for ax in figure.axes) == count


@pytest.mark.slow(3)
def test_a_noisy_picture_stays_small(tmp_path):
    noise = np.random.default_rng(0).normal(size=(400, 300))
    panels = [Panel(title=str(k), values=noise, unit="m") for k in range(6)]
    save_layers(tmp_path / "noise.png", panels, extent=EXTENT, path_xy=np.array([[0, 11], [1, 12]]), title="noise")
    assert (tmp_path / "noise.png").stat().st_size < MAX_BYTES
    assert Image.open(tmp_path / "noise.png").size[0] > 500


@pytest.mark.slow(1)
def test_draws_maps_without_a_known_cell_and_of_one_height(tmp_path):
    panels = [Panel(title="a", values=np.full((3, 3), np.nan)), Panel(title="b", values=np.ones((3, 3)))]
    save_layers(tmp_path / "empty.png", panels, extent=EXTENT)
    assert (tmp_path / "empty.png").read_bytes().startswith(b"\x89PNG")


def test_refuses_what_is_no_layer():
    with pytest.raises(ValueError, match="at least one Panel"):
        draw_layers([], extent=EXTENT)
    with pytest.raises(ValueError, match=r"panel 'time': expected values \(H, W\) or \(H, W, 3\), got \(1, 3, 4\)"):
        draw_layers([Panel(title="time", values=np.zeros((1, 3, 4)))], extent=EXTENT)
