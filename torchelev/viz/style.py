"""One look for all figures: readable at half width, colours for colour-blind readers, PNG and SVG.

Needs matplotlib (``pip install 'torchelev[io]'``).
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from torchelev.errors import require
from torchelev.files.output_files import MARK, atomic_file
from torchelev.viz.palette import COLORS, UNKNOWN_COLOR

MAX_BYTES = 300_000  #: of a picture
_UNSEEN = 8  # of 255, by which a colour may change

SETTINGS: Mapping[str, Any] = MappingProxyType(
    {
        "font.size": 11.0,  # at a width of 8 inches, 8 pixels of x-height on half of a 900 pixel column
        "axes.titlesize": 11.0,
        "axes.labelsize": 11.0,
        "xtick.labelsize": 10.0,
        "ytick.labelsize": 10.0,
        "legend.fontsize": 10.0,
        "axes.prop_cycle": cycler(color=COLORS),
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": False,
        "grid.alpha": 0.3,
        "legend.frameon": False,
        "lines.linewidth": 2.0,
        "image.interpolation": "nearest",
        "image.origin": "lower",
        "svg.hashsalt": MARK,  # the same figure gives the same file
    }
)

_CROPPED: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.1}


@contextmanager
def styled() -> Iterator[None]:
    """Draw figures in this style within the context, or in a function that this decorates."""
    settings: Any = dict(SETTINGS)
    with matplotlib.rc_context(settings):
        yield


def make_figure(width: float, height: float) -> Figure:
    """Return an empty figure [inches] that opens no window. Draw about 8 inches wide for a full column."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def draw_cells(
    ax: Axes,
    values: Any,
    extent: tuple[float, float, float, float],
    cmap: str,
    vmin: float | None = None,
    vmax: float | None = None,
) -> AxesImage:
    """Draw a layer with x to the right and y up, unknown cells grey, and return the image.

    Args:
        ax: where to draw.
        values: (H, W) as from `ElevationMap.layer`, NaN where unknown.
        extent: x_min, x_max, y_min, y_max [m].
        cmap: name of a matplotlib colour map.
        vmin: value of the lowest colour; None: the lowest value.
        vmax: value of the highest colour; None: the highest value.
    """
    ax.set_facecolor(UNKNOWN_COLOR)
    for spine in ax.spines.values():
        spine.set_visible(True)
    return ax.imshow(values.T, extent=extent, cmap=cmap, vmin=vmin, vmax=vmax, origin="lower", interpolation="nearest")


def require_picture(path: str | Path) -> None:
    """Raise ValueError unless `write` knows the format that the ending of `path` names."""
    known, suffix = sorted(Figure().canvas.get_supported_filetypes()), Path(path).suffix
    is_known = suffix.lower().removeprefix(".") in ("", *known)
    require(is_known, "out", "must be a picture", f"one of suffix {suffix}", f"name it .png, or {', '.join(known)}")


def write(figure: Figure, path: str | Path) -> None:
    """Write a figure in the format that the ending of `path` names, by default as a small PNG."""
    ending = Path(path).suffix.lower().removeprefix(".") or "png"
    with styled(), atomic_file(path) as file:
        if ending in ("png", "svg"):
            file.write(small_png(figure) if ending == "png" else _small_svg(figure))
        else:
            figure.savefig(file, format=ending, **_CROPPED)


def png_info() -> PngInfo:
    """Return a PNG's metadata, which names this library."""
    info = PngInfo()
    info.add_text("Software", MARK)
    return info


def small_png(figure: Figure) -> bytes:
    """Return a PNG below `MAX_BYTES`, with a palette where the change is invisible, in fewer pixels to fit."""
    for dpi, colors in ((110, None), (90, None), (100, 256), (75, 256), (55, 256)):
        raw, small = io.BytesIO(), io.BytesIO()
        figure.savefig(raw, format="png", dpi=dpi, **_CROPPED)
        picture = Image.open(raw).convert("RGB")
        picture = picture.quantize(colors, dither=Image.Dither.NONE) if colors else _with_palette(picture)
        picture.save(small, format="png", optimize=True, pnginfo=png_info())
        if small.tell() < MAX_BYTES:
            break
    return small.getvalue()


def _with_palette(picture: Image.Image) -> Image.Image:
    """Return an RGB picture with a palette of 256 colours, unless a colour would change by more than `_UNSEEN`."""
    small = picture.quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    colors, others = (np.asarray(each).astype(np.int16) for each in (picture, small.convert("RGB")))
    return small if np.abs(colors - others).max() <= _UNSEEN else picture


def _small_svg(figure: Figure) -> bytes:
    """Return an SVG whose images have palettes, at resolutions that keep it below `MAX_BYTES` where they can."""
    for dpi in (100, 90, 80, 70, 55):
        raw = io.BytesIO()
        figure.savefig(raw, format="svg", dpi=dpi, metadata={"Date": None, "Creator": MARK}, **_CROPPED)
        small = re.sub(rb"(?<=data:image/png;base64,)[^\"]+", _shrink_image, raw.getvalue())
        if len(small) < MAX_BYTES:
            break
    return small


def _shrink_image(image: re.Match[bytes]) -> bytes:
    """Return a PNG in base64 with a palette if it has at most 256 colours, as an image of one colour map has."""
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(image[0]))).convert("RGBA"))
    colors, index = np.unique(pixels.reshape(-1, 4), axis=0, return_inverse=True)
    if len(colors) > 256:
        return image[0]
    picture, small = Image.fromarray(index.reshape(pixels.shape[:2]).astype(np.uint8), "P"), io.BytesIO()
    picture.putpalette(colors[:, :3].tobytes())
    picture.save(small, format="png", optimize=True, transparency=colors[:, 3].tobytes())
    return base64.b64encode(small.getvalue())
