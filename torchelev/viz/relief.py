"""Heights as shaded colours, lit from the upper left as on maps of mountains."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from torchelev.viz.palette import HEIGHTS, UNKNOWN_COLOR

_AMBIENT = 0.5  # brightness where no light falls; flat ground has 1
_BRIGHTEST = 1.25
_CONTRAST = 60  # by which light and shadow differ on black: heights of dark colours have relief, too


def draw_relief(values: NDArray, resolution: float, low: float, high: float) -> NDArray[np.uint8]:
    """Return the shaded colours of heights, a pixel for each cell: x to the right, y up, unknown cells grey.

    Args:
        values: (H, W) [m] as from `ElevationMap.layer`: i grows with +x, j with +y, NaN where unknown.
        resolution: [m] of a cell.
        low: [m] with the first colour.
        high: [m] with the last colour.

    Returns:
        (W, H, 3) pixels in rows from the largest y to the smallest.
    """
    values = np.asarray(values, dtype=np.float32)
    known = np.isfinite(values)
    index = np.clip((np.where(known, values, low) - low) * (255 / (high - low)), 0, 255).astype(np.uint8)
    pixels = _light(_heights()[index], _brightness(values, resolution)[..., None])
    pixels[~known] = rgb(UNKNOWN_COLOR)
    return np.ascontiguousarray(pixels.transpose(1, 0, 2)[::-1])


def relief_colors(num_heights: int = 26, num_shades: int = 9) -> NDArray[np.uint8]:
    """Return colours (K, 3) that `draw_relief` uses, for pictures with a palette."""
    heights = _heights()[np.linspace(0, 255, num_heights).astype(int)]
    shades = np.linspace(_AMBIENT, _BRIGHTEST, num_shades, dtype=np.float32)
    return _light(heights[:, None], shades[:, None]).reshape(-1, 3)


def rgb(color: str) -> NDArray[np.uint8]:
    """Return a colour of matplotlib as three bytes."""
    return np.round(np.array(to_rgb(color)) * 255).astype(np.uint8)


def _heights() -> NDArray[np.float32]:
    return (matplotlib.colormaps[HEIGHTS](np.linspace(0, 1, 256))[:, :3] * 255).astype(np.float32)


def _light(colors: NDArray[np.float32], brightness: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.clip(colors * brightness + _CONTRAST * (brightness - 1), 0, 255).astype(np.uint8)


def _brightness(values: NDArray[np.float32], resolution: float) -> NDArray[np.float32]:
    """Return the brightness of each cell: 1 on flat ground, and where a neighbour is unknown."""
    padded = np.pad(values, 1, mode="edge")
    slope_x = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / (2 * resolution)
    slope_y = (padded[1:-1, 2:] - padded[1:-1, :-2]) / (2 * resolution)
    # The light comes from (-1, 1, sqrt 2), at 45 degrees, onto the normal (-slope_x, -slope_y, 1).
    light = (1 + (slope_x - slope_y) / np.sqrt(np.float32(2))) / np.sqrt(1 + slope_x**2 + slope_y**2)
    brightness = np.clip(_AMBIENT + (1 - _AMBIENT) * light, _AMBIENT, _BRIGHTEST)
    return np.where(np.isfinite(brightness), brightness, np.float32(1))
