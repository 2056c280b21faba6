"""The frames of a growing map: heights, unknown cells, the path and the legend, always of one size."""

import numpy as np
import pytest

from torchelev.viz.map_frames import MapFrames
from torchelev.viz.palette import ROBOT_COLOR, UNKNOWN_COLOR
from torchelev.viz.relief import draw_relief, relief_colors, rgb

GREY, ORANGE = rgb(UNKNOWN_COLOR), rgb(ROBOT_COLOR)
CENTER, PATH = np.zeros(2), np.array([[-1.0, 0.0], [0.0, 0.0]])


def slope(height=1.0, shape=(60, 40)):
    """Ground that rises along x; unknown where y is large."""
    values = np.broadcast_to(np.linspace(0, height, shape[0])[:, None], shape).copy()
    values[:, -shape[1] // 4 :] = np.nan
    return values


def is_near(pixels, color, tolerance=0):
    return (np.abs(pixels.astype(int) - color) <= tolerance).all(-1)


def test_cells_are_pixels_with_x_to_the_right_and_y_up():
    pixels = draw_relief(slope(), 0.1, 0.0, 1.0)
    assert pixels.shape == (40, 60, 3)
    assert is_near(pixels[:10], GREY).all() and not is_near(pixels[10:], GREY).any()
    assert pixels[20, -1].sum() > pixels[20, 0].sum() + 200  # yellow above violet


def test_slopes_that_face_the_light_are_brighter():
    x = np.linspace(-2, 2, 40)
    ridge = np.broadcast_to(-0.5 * np.abs(x)[:, None], (40, 20))  # along y; the light comes from -x and +y
    left, right = draw_relief(ridge, 0.1, -1.0, 0.0)[10, [10, 29]].astype(int)
    assert left.sum() > right.sum() + 60
    flat = draw_relief(np.zeros((4, 4)), 0.1, -1.0, 1.0)
    assert is_near(flat, flat[0, 0]).all() and is_near(relief_colors(201), flat[0, 0], 12).any()


@pytest.mark.parametrize("shape", [(1, 1), (3, 50), (250, 250), (1000, 400)])
def test_all_frames_have_one_even_size_that_is_bounded(shape):
    frames, rng = MapFrames(shape, 0.05, "drive", side=480), np.random.default_rng(0)
    sizes = set()
    for k in range(3):
        values = rng.normal(size=shape) * 10**k
        frame = frames.draw(values if k else np.full(shape, np.nan), CENTER - 1e5 * k, PATH, "now")
        sizes.add(frame.shape)
        assert frame.dtype == np.uint8
    assert len(sizes) == 1
    height, width, _ = sizes.pop()
    assert height % 2 == width % 2 == 0 and max(height, width) < 1.6 * 480


def test_the_path_ends_in_a_dot_at_the_robot():
    frames = MapFrames((100, 100), 0.1, side=500)
    bare = frames.draw(np.zeros((100, 100)), CENTER, np.zeros((0, 2)))
    drawn = frames.draw(np.zeros((100, 100)), CENTER, np.array([[-4.0, 2.0], [3.0, 2.0]]))
    changed = np.argwhere((drawn != bare).any(-1))
    (top, left), (bottom, right) = changed.min(0), changed.max(0)
    assert abs((right - left) - 350) < 25 and bottom - top < 25
    dot = np.argwhere(is_near(drawn, ORANGE) & (np.arange(drawn.shape[1]) > right - 12))
    assert dot.mean(0) == pytest.approx([(top + bottom) / 2, right - 9], abs=4)


def test_colours_widen_at_once_and_narrow_slowly():
    frames = MapFrames((60, 40), 0.1)
    assert frames._follow(np.full((2, 2), np.nan)) == (0.0, 1.0)
    for height in (1.0, 3.0):
        assert frames._follow(slope(height)) == pytest.approx((0.01 * height, 0.99 * height), abs=0.03 * height)
    wide = [frames._follow(slope(1.0))[1] for _ in range(60)]
    assert wide[0] > 2.5 and (np.diff(wide) < 0).all() and wide[-1] < 1.2
    low, high = MapFrames((2, 2), 0.1)._follow(np.full((2, 2), 400.0))
    assert high - low == pytest.approx(0.1) and low < 400 < high


def test_a_palette_has_the_colours_of_frames():
    frame = MapFrames((60, 40), 0.1, "drive").draw(slope(), CENTER, PATH, "now")
    colors = MapFrames.colors()
    assert len(colors) <= 256
    distance = np.abs(frame.reshape(-1, 1, 3)[::101].astype(int) - colors[None]).max(-1).min(1)
    assert np.percentile(distance, 98) < 24
