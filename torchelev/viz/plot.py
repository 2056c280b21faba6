"""Draw map layers as a picture: panels side by side, metres on the axes, grey where nothing is known.

Needs matplotlib (``pip install 'torchelev[io]'``). The figure is built on the Agg canvas itself, so that drawing
never opens a window and never changes the backend of the program that calls it.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from torchelev.output_files import MARK, atomic_file

UNKNOWN_COLOR = "#d9d9d9"
MAX_BYTES = 300_000


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One layer to draw.

    `values` is (H, W) as `ElevationMap.layer` gives it (i grows with +x, j with +y), NaN where unknown. Limits left at
    None follow the values, less the outermost 1 % at either end, so that one stray cell does not bleach the picture.
    """

    title: str  #: above the panel
    values: NDArray  #: (H, W), NaN where unknown
    unit: str = ""  #: beside the colour bar
    cmap: str = "viridis"  #: Matplotlib's name of the colours
    vmin: float | None = None  #: value of the lowest colour; None: the lowest value
    vmax: float | None = None  #: value of the highest colour; None: the highest value


def save_layers(
    path: str | Path,
    panels: Sequence[Panel],
    *,
    extent: tuple[float, float, float, float],
    path_xy: NDArray | None = None,
    title: str | None = None,
) -> None:
    """Write `panels` into one PNG, x to the right and y up, as on paper.

    `extent` is (x_min, x_max, y_min, y_max) [m], the outer borders of the map in the map frame. `path_xy` (T, 2) [m] is
    drawn over every panel, its last point as a dot. Raises ValueError if there is no panel or one is not 2-D.
    """
    figure = draw_layers(panels, extent=extent, path_xy=path_xy, title=title)
    with atomic_file(path) as file:
        file.write(_small_png(figure))


def draw_layers(
    panels: Sequence[Panel],
    *,
    extent: tuple[float, float, float, float],
    path_xy: NDArray | None = None,
    title: str | None = None,
) -> Figure:
    """Draw what `save_layers` writes and return the matplotlib figure. Arguments as there."""
    _check_panels(panels)
    rows, columns = _tidy_grid(len(panels))
    width, height = _panel_size(extent)
    figure = Figure(figsize=(columns * width, rows * height + (0.4 if title else 0.0)), layout="compressed")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for ax, panel in zip(axes, panels, strict=False):
        _draw_panel(figure, ax, panel, extent, path_xy)
    for ax in axes[len(panels) :]:
        ax.set_visible(False)
    _label_outer(axes[: len(panels)], columns)
    if title:
        figure.suptitle(title, fontsize=12)
    return figure


def _check_panels(panels: Sequence[Panel]) -> None:
    if not panels:
        raise ValueError("panels: expected at least one Panel, got none")
    for panel in panels:
        if np.ndim(panel.values) != 2:
            raise ValueError(f"panel '{panel.title}': expected values (H, W), got {np.shape(panel.values)}")


def _tidy_grid(count: int) -> tuple[int, int]:
    """Rows and columns for `count` panels: one row up to three, then as wide as three or four."""
    if count <= 3:
        return 1, count
    columns = 4 if count % 4 == 0 and count > 4 else 3 if count > 4 else 2
    return math.ceil(count / columns), columns


def _panel_size(extent: tuple[float, float, float, float]) -> tuple[float, float]:
    """Inches for one panel with its colour bar, in the shape of the map but never a thread."""
    x_min, x_max, y_min, y_max = extent
    shape = (y_max - y_min) / (x_max - x_min)
    shape = min(max(shape, 0.35), 2.5)
    return 3.2 / max(1.0, shape**0.5) + 1.0, 3.3 * shape / max(1.0, shape**0.5) + 0.75


def _draw_panel(figure: Figure, ax: Axes, panel: Panel, extent, path_xy: NDArray | None) -> None:
    values = np.ma.masked_invalid(np.asarray(panel.values, dtype=float))
    vmin, vmax = limits(panel, values)
    ax.set_facecolor(UNKNOWN_COLOR)
    # imshow takes rows downwards; the map's first index is x. Transposed and with its origin below, x runs right, y up.
    image = ax.imshow(
        values.T, origin="lower", extent=extent, cmap=panel.cmap, vmin=vmin, vmax=vmax, interpolation="nearest"
    )
    if path_xy is not None and len(path_xy):
        _draw_path(ax, np.asarray(path_xy, dtype=float))
    ax.set(xlim=extent[:2], ylim=extent[2:], title=panel.title)
    bar = figure.colorbar(image, ax=ax, pad=0.02)
    bar.set_label(f"[{panel.unit}]" if panel.unit else "")


def limits(panel: Panel, values: np.ma.MaskedArray) -> tuple[float, float]:
    """Return a panel's limits, those that it leaves open from its values."""
    known = values.compressed()
    low, high = np.percentile(known, [1, 99]) if known.size else (0.0, 1.0)
    vmin = float(low) if panel.vmin is None else panel.vmin
    vmax = float(high) if panel.vmax is None else panel.vmax
    return vmin, (vmax if vmax > vmin else vmin + 1e-3)


def _draw_path(ax: Axes, xy: NDArray) -> None:
    ax.plot(xy[:, 0], xy[:, 1], color="white", linewidth=2.4)
    ax.plot(xy[:, 0], xy[:, 1], color="crimson", linewidth=1.2)
    ax.plot(*xy[-1, :2], "o", color="crimson", markeredgecolor="white", markersize=5)


def _label_outer(axes, columns: int) -> None:
    for k, ax in enumerate(axes):
        if k % columns == 0:
            ax.set_ylabel("y, map frame [m]")
        if k + columns >= len(axes):
            ax.set_xlabel("x, map frame [m]")
            ax.tick_params(labelbottom=True)


def png_info() -> PngInfo:
    """Return the entry that tells whose picture a PNG is."""
    info = PngInfo()
    info.add_text("Software", MARK)
    return info


def _small_png(figure: Figure) -> bytes:
    """PNG below `MAX_BYTES`: in full colour if that fits, else with a palette (bands in the bars), then coarser."""
    for dpi, colors in ((110, None), (90, None), (100, 256), (75, 256), (55, 256)):
        raw, small = io.BytesIO(), io.BytesIO()
        figure.savefig(raw, format="png", dpi=dpi, bbox_inches="tight", pad_inches=0.1)
        picture = Image.open(raw).convert("RGB")
        picture = picture.quantize(colors, dither=Image.Dither.NONE) if colors else picture
        picture.save(small, format="png", optimize=True, pnginfo=png_info())
        if small.tell() < MAX_BYTES:
            break
    return small.getvalue()
