"""Write one layer as an image whose pixels are cells, with a colour map, a scale bar and a colour bar.

For papers, web pages and other programs; `plot.py` draws layers with axes, side by side. Needs matplotlib
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
from torchelev.output_files import atomic_file
from torchelev.viz.plot import UNKNOWN_COLOR, Panel, limits, png_info

FONT = Path(matplotlib.get_data_path(), "fonts/ttf/DejaVuSans.ttf")
# Sizes in pixels.
TEXT = 12
GAP = 6
LINE = 4  # thickness of the scale bar
BAR = 12  # width of the colour bar


def save_image(
    path: str | Path,
    values: NDArray,
    resolution: float,
    *,
    cmap: str = "viridis",
    vmin: float | None = None,
    vmax: float | None = None,
    scale: int = 1,
    scale_bar: bool = True,
    color_bar: bool = False,
    unit: str = "m",
) -> None:
    """Write a layer as a PNG, x to the right and y up, each cell a square of `scale` pixels, unknown cells grey.

    Args:
        path: of the file.
        values: (H, W) as `ElevationMap.layer` gives one environment's (i grows with +x, j with +y), NaN where unknown.
        resolution: [m] of a cell.
        cmap: name of a matplotlib colour map.
        vmin, vmax: the values of its ends; None as in `plot.Panel`: of the values, less the outermost 1 %.
        scale: pixels along a cell's side.
        scale_bar: draw a length of 1, 2 or 5 times a power of ten below the map, with its metres.
        color_bar: draw the colours right of the map, with their limits in `unit`.

    Raises ValueError for values that are not (H, W), and for settings out of range.
    """
    shape = np.shape(values)
    require(len(shape) == 2 and min(shape) > 0, "values", "expected (H, W)", shape, "give one environment's layer")
    require_positive(resolution=resolution)
    require_count("scale", scale, "give pixels per cell")
    known = cmap in matplotlib.colormaps
    require(known, "cmap", "must name a colour map of matplotlib", repr(cmap), "see matplotlib.colormaps")
    if vmin is not None and vmax is not None:
        require(vmin < vmax, "vmin", "must lie below vmax", f"{vmin} and {vmax}", "swap them, or leave out one")
    panel = Panel(title="", values=values, unit=unit, cmap=cmap, vmin=vmin, vmax=vmax)
    heights = np.ma.masked_invalid(np.asarray(values, dtype=float))
    low, high = limits(panel, heights)
    colors = matplotlib.colormaps[cmap]
    picture = Image.fromarray(_cells(heights, colors, low, high, scale))
    if color_bar:
        picture = _beside(picture, _color_bar(colors, f"{low:.3g} {unit}", f"{high:.3g} {unit}", picture.height))
    if scale_bar:
        picture = _below(picture, _scale_bar(shape[0] * resolution, scale / resolution))
    with atomic_file(path) as file:
        picture.save(file, format="png", optimize=True, pnginfo=png_info())


def round_length(longest: float) -> float:
    """Return the greatest of 1, 2 and 5 times a power of ten that is not above `longest`."""
    longest *= 1 + 1e-9  # 0.5 may come as 0.4999...
    power = 10.0 ** math.floor(math.log10(longest))
    return max(step * power for step in (1, 2, 5) if step == 1 or step * power <= longest)


def _cells(heights: np.ma.MaskedArray, colors: Colormap, low: float, high: float, scale: int) -> NDArray[np.uint8]:
    """Colour the cells: rows of pixels run down, so the first has the largest y."""
    share = (heights.filled(low) - low) / (high - low)  # beyond 0 and 1, a colour map stays at its ends
    pixels = colors(share, bytes=True)[..., :3]
    pixels[np.ma.getmaskarray(heights)] = _bytes(UNKNOWN_COLOR)
    upright = pixels.transpose(1, 0, 2)[::-1]
    return np.ascontiguousarray(upright.repeat(scale, axis=0).repeat(scale, axis=1))


def _bytes(color: str) -> NDArray[np.uint8]:
    return np.round(np.array(to_rgb(color)) * 255).astype(np.uint8)


def _scale_bar(length: float, pixels_per_metre: float) -> Image.Image:
    """Draw a bar of up to half of the map's length [m], and its length beside it."""
    metres = round_length(length / 2)
    pixels = max(1, round(metres * pixels_per_metre))
    text = f"{metres:g} m"
    picture = _paper(GAP + pixels + GAP + _width(text) + GAP, TEXT + 2 * GAP)
    draw = ImageDraw.Draw(picture)
    top = (picture.height - LINE) // 2
    draw.rectangle((GAP, top, GAP + pixels - 1, top + LINE - 1), fill="black")
    _write(draw, (2 * GAP + pixels, picture.height // 2), text, "lm")
    return picture


def _color_bar(colors: Colormap, low: str, high: str, height: int) -> Image.Image:
    """Draw all colours, the highest at the top, and the limits at the ends."""
    height = max(height, 2 * TEXT + GAP)
    ramp = colors(np.linspace(1, 0, height), bytes=True)[:, None, :3].repeat(BAR, axis=1)
    picture = _paper(GAP + BAR + GAP + max(_width(low), _width(high)) + GAP, height)
    picture.paste(Image.fromarray(np.ascontiguousarray(ramp)), (GAP, 0))
    draw = ImageDraw.Draw(picture)
    _write(draw, (BAR + 2 * GAP, 0), high, "la")
    _write(draw, (BAR + 2 * GAP, height - 1), low, "ld")
    return picture


def _paper(width: int, height: int) -> Image.Image:
    return Image.new("RGB", (width, height), "white")


def _font() -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(FONT), TEXT)


def _width(text: str) -> int:
    return math.ceil(_font().getlength(text))


def _write(draw: ImageDraw.ImageDraw, place: tuple[int, int], text: str, anchor: str) -> None:
    draw.text(place, text, fill="black", font=_font(), anchor=anchor)


def _beside(left: Image.Image, right: Image.Image) -> Image.Image:
    picture = _paper(left.width + right.width, max(left.height, right.height))
    picture.paste(left, (0, 0))
    picture.paste(right, (left.width, 0))
    return picture


def _below(upper: Image.Image, lower: Image.Image) -> Image.Image:
    picture = _paper(max(upper.width, lower.width), upper.height + lower.height)
    picture.paste(upper, (0, 0))
    picture.paste(lower, (0, upper.height))
    return picture
