"""One layer as an image whose pixels are cells, with a colour map, a scale bar and a colour bar.

For papers, web pages and other programs; `plot.py` draws several layers with axes. Needs matplotlib
(``pip install 'torchelev[io]'``).
"""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.colors import Colormap, to_rgb
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from torchelev.errors import require, require_count, require_positive
from torchelev.files.output_files import atomic_file
from torchelev.viz.palette import HEIGHTS, UNKNOWN_COLOR
from torchelev.viz.plot import Panel, color_limits
from torchelev.viz.style import png_info

_FONT_FILE = Path(matplotlib.get_data_path(), "fonts/ttf/DejaVuSans.ttf")
_FONT_SIZE = 12  # [pixels], as all sizes here
_GAP = 6
_SCALE_BAR_HEIGHT = 4
_COLOR_BAR_WIDTH = 12


def save_image(
    path: str | Path,
    values: NDArray,
    resolution: float,
    *,
    cmap: str = HEIGHTS,
    vmin: float | None = None,
    vmax: float | None = None,
    scale: int = 1,
    scale_bar: bool = True,
    color_bar: bool = False,
    unit: str = "m",
) -> None:
    """Write a layer as a PNG: x to the right, y up, each cell a square of `scale` pixels, unknown cells grey.

    Args:
        path: of the file.
        values: (H, W) one environment's layer, as from `ElevationMap.layer`: i grows with +x, j with +y, NaN where
            unknown.
        resolution: [m] of a cell.
        cmap: name of a matplotlib colour map.
        vmin: value of the lowest colour; default: the values' 1st percentile.
        vmax: value of the highest colour; default: the values' 99th percentile.
        scale: [pixels] side of a cell.
        scale_bar: draw a bar of 1, 2 or 5 times a power of ten metres below the map, with its length.
        color_bar: draw the colours to the right of the map, with their limits.
        unit: of the values, for the colour bar.

    Raises:
        ValueError: if the values are not (H, W), or a setting is out of range.
    """
    shape = np.shape(values)
    require(len(shape) == 2 and min(shape) > 0, "values", "expected (H, W)", shape, "give one environment's layer")
    require_positive(resolution=resolution)
    require_count("scale", scale, "give pixels per cell")
    exists = cmap in matplotlib.colormaps
    require(exists, "cmap", "must name a colour map of matplotlib", repr(cmap), "see matplotlib.colormaps")
    if vmin is not None and vmax is not None:
        require(vmin < vmax, "vmin", "must lie below vmax", f"{vmin} and {vmax}", "swap them, or leave out one")
    panel = Panel(title="", values=values, unit=unit, cmap=cmap, vmin=vmin, vmax=vmax)
    heights = np.ma.masked_invalid(np.asarray(values, dtype=float))
    low, high = color_limits(panel, heights)
    colors = matplotlib.colormaps[cmap]
    picture = Image.fromarray(_draw_cells(heights, colors, low, high, scale))
    if color_bar:
        picture = _beside(picture, _draw_color_bar(colors, f"{low:.3g} {unit}", f"{high:.3g} {unit}", picture.height))
    if scale_bar:
        picture = _below(picture, _draw_scale_bar(shape[0] * resolution, scale / resolution))
    with atomic_file(path) as file:
        picture.save(file, format="png", optimize=True, pnginfo=png_info())


def round_length(max_length: float) -> float:
    """Return the largest length of 1, 2 or 5 times a power of ten up to `max_length`."""
    max_length *= 1 + 1e-9  # 0.5 may come as 0.4999...
    power = 10.0 ** math.floor(math.log10(max_length))
    return max(step * power for step in (1, 2, 5) if step == 1 or step * power <= max_length)


def _draw_cells(values: np.ma.MaskedArray, colors: Colormap, low: float, high: float, scale: int) -> NDArray[np.uint8]:
    """Colour the cells. Rows of pixels run downwards, so the first one has the largest y."""
    fraction = (values.filled(low) - low) / (high - low)  # below 0 and above 1, a colour map keeps its end colours
    pixels = colors(fraction, bytes=True)[..., :3]
    pixels[np.ma.getmaskarray(values)] = _rgb(UNKNOWN_COLOR)
    upright = pixels.transpose(1, 0, 2)[::-1]
    return np.ascontiguousarray(upright.repeat(scale, axis=0).repeat(scale, axis=1))


def _rgb(color: str) -> NDArray[np.uint8]:
    return np.round(np.array(to_rgb(color)) * 255).astype(np.uint8)


def _draw_scale_bar(length: float, pixels_per_metre: float) -> Image.Image:
    """Draw a bar of up to half the map's length [m], with its own length beside it."""
    metres = round_length(length / 2)
    pixels = max(1, round(metres * pixels_per_metre))
    text = f"{metres:g} m"
    picture = _blank(_GAP + pixels + _GAP + _width(text) + _GAP, _FONT_SIZE + 2 * _GAP)
    draw = ImageDraw.Draw(picture)
    top = (picture.height - _SCALE_BAR_HEIGHT) // 2
    draw.rectangle((_GAP, top, _GAP + pixels - 1, top + _SCALE_BAR_HEIGHT - 1), fill="black")
    _write(draw, (2 * _GAP + pixels, picture.height // 2), text, "lm")
    return picture


def _draw_color_bar(colors: Colormap, low: str, high: str, height: int) -> Image.Image:
    """Draw all colours, the highest value at the top, with the limits at the ends."""
    height = max(height, 2 * _FONT_SIZE + _GAP)
    ramp = colors(np.linspace(1, 0, height), bytes=True)[:, None, :3].repeat(_COLOR_BAR_WIDTH, axis=1)
    picture = _blank(_GAP + _COLOR_BAR_WIDTH + _GAP + max(_width(low), _width(high)) + _GAP, height)
    picture.paste(Image.fromarray(np.ascontiguousarray(ramp)), (_GAP, 0))
    draw = ImageDraw.Draw(picture)
    _write(draw, (_COLOR_BAR_WIDTH + 2 * _GAP, 0), high, "la")
    _write(draw, (_COLOR_BAR_WIDTH + 2 * _GAP, height - 1), low, "ld")
    return picture


def _blank(width: int, height: int) -> Image.Image:
    return Image.new("RGB", (width, height), "white")


def _font() -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(_FONT_FILE), _FONT_SIZE)


def _width(text: str) -> int:
    return math.ceil(_font().getlength(text))


def _write(draw: ImageDraw.ImageDraw, xy: tuple[int, int], text: str, anchor: str) -> None:
    draw.text(xy, text, fill="black", font=_font(), anchor=anchor)


def _beside(left: Image.Image, right: Image.Image) -> Image.Image:
    picture = _blank(left.width + right.width, max(left.height, right.height))
    picture.paste(left, (0, 0))
    picture.paste(right, (left.width, 0))
    return picture


def _below(upper: Image.Image, lower: Image.Image) -> Image.Image:
    picture = _blank(max(upper.width, lower.width), upper.height + lower.height)
    picture.paste(upper, (0, 0))
    picture.paste(lower, (0, upper.height))
    return picture
