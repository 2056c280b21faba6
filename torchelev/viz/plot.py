"""Map layers as panels side by side: metres on the axes, unknown cells grey.

Needs matplotlib (``pip install 'torchelev[io]'``). Figures use the Agg canvas directly, so that drawing neither opens a
window nor changes the calling program's backend.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch
from numpy.typing import NDArray

from torchelev.files.output_files import atomic_file
from torchelev.viz.palette import HEIGHTS, ROBOT_COLOR, UNKNOWN_COLOR
from torchelev.viz.style import small_png, styled


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One layer to draw.

    By default the colours span the 1st to the 99th percentile of the values, so that a single outlier does not wash out
    the picture.
    """

    title: str  #: above the panel
    #: (H, W), as from `ElevationMap.layer`: i grows with +x, j with +y, NaN where unknown; or (H, W, 3), colours of the
    #: cells from 0 to 1
    values: NDArray
    unit: str = ""  #: of the values, beside the colour bar
    cmap: str = HEIGHTS  #: name of a matplotlib colour map
    vmin: float | None = None  #: value of the lowest colour; None: the 1st percentile
    vmax: float | None = None  #: value of the highest colour; None: the 99th percentile
    legend: Mapping[str, Any] = field(default_factory=dict)  #: of colours: name -> (3,) its colour


def save_layers(
    path: str | Path,
    panels: Sequence[Panel],
    *,
    extent: tuple[float, float, float, float],
    path_xy: NDArray | None = None,
    title: str | None = None,
) -> None:
    """Write panels as one PNG, x to the right and y up.

    Args:
        path: of the file.
        panels: at least one.
        extent: (x_min, x_max, y_min, y_max) [m], the map's borders in the map frame.
        path_xy: (T, 2) [m] a path to draw over every panel, its last point as a dot.
        title: above all panels.

    Raises:
        ValueError: if there is no panel, or a panel's values are neither (H, W) nor (H, W, 3).
    """
    figure = draw_layers(panels, extent=extent, path_xy=path_xy, title=title)
    with atomic_file(path) as file:
        file.write(small_png(figure))


@styled()
def draw_layers(
    panels: Sequence[Panel],
    *,
    extent: tuple[float, float, float, float],
    path_xy: NDArray | None = None,
    title: str | None = None,
) -> Figure:
    """Return what `save_layers` writes as a matplotlib figure. Arguments and errors as there."""
    _check_panels(panels)
    rows, columns = _arrange(len(panels))
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
        figure.suptitle(title, fontsize=11)
    return figure


def _check_panels(panels: Sequence[Panel]) -> None:
    if not panels:
        raise ValueError("panels: expected at least one Panel, got none")
    for panel in panels:
        shape = np.shape(panel.values)
        if len(shape) != 2 and not (len(shape) == 3 and shape[-1] == 3):
            raise ValueError(f"panel '{panel.title}': expected values (H, W) or (H, W, 3), got {shape}")


def _arrange(count: int) -> tuple[int, int]:
    """Return rows and columns for panels: one row up to three panels, then two to four columns."""
    if count <= 3:
        return 1, count
    columns = 4 if count % 4 == 0 and count > 4 else 3 if count > 4 else 2
    return math.ceil(count / columns), columns


def _panel_size(extent: tuple[float, float, float, float]) -> tuple[float, float]:
    """Return width and height [inches] of a panel with its colour bar, in the map's aspect ratio within limits."""
    x_min, x_max, y_min, y_max = extent
    aspect = (y_max - y_min) / (x_max - x_min)
    aspect = min(max(aspect, 0.35), 2.5)
    return 3.2 / max(1.0, aspect**0.5) + 1.0, 3.3 * aspect / max(1.0, aspect**0.5) + 0.75


def _draw_panel(figure: Figure, ax: Axes, panel: Panel, extent, path_xy: NDArray | None) -> None:
    ax.set_facecolor(UNKNOWN_COLOR)
    values = np.asarray(panel.values, dtype=float)
    image = _draw_colors(ax, values, extent) if values.ndim == 3 else _draw_values(ax, panel, values, extent)
    if path_xy is not None and len(path_xy):
        _draw_path(ax, np.asarray(path_xy, dtype=float))
    ax.set(xlim=extent[:2], ylim=extent[2:], title=panel.title)
    bar = figure.colorbar(image, ax=ax, pad=0.02)
    bar.set_label(f"[{panel.unit}]" if panel.unit else "")
    if values.ndim == 3:
        bar.ax.set_visible(False)  # its place stays, so that all panels have one size
        _draw_legend(ax, panel.legend)


def _draw_values(ax: Axes, panel: Panel, values: NDArray, extent) -> AxesImage:
    masked = np.ma.masked_invalid(values)
    vmin, vmax = color_limits(panel, masked)
    # The map's first index is x, imshow's runs down: transposed and with the origin below, x runs right and y up.
    return ax.imshow(
        masked.T, origin="lower", extent=extent, cmap=panel.cmap, vmin=vmin, vmax=vmax, interpolation="nearest"
    )


def _draw_colors(ax: Axes, values: NDArray, extent) -> AxesImage:
    known = np.isfinite(values).all(-1, keepdims=True)
    rgba = np.concatenate([np.nan_to_num(values), known], -1)
    return ax.imshow(rgba.swapaxes(0, 1), origin="lower", extent=extent, interpolation="nearest")


def _draw_legend(ax: Axes, colors: Mapping[str, Any]) -> None:
    if colors:
        patches = [Patch(facecolor=tuple(color), label=name) for name, color in colors.items()]
        box: dict[str, Any] = {"frameon": True, "framealpha": 0.8, "fontsize": 8, "handlelength": 1.0}
        ax.legend(handles=patches, loc="lower left", **box)


def color_limits(panel: Panel, values: np.ma.MaskedArray) -> tuple[float, float]:
    """Return the values of a panel's lowest and highest colour, by default percentiles of its values."""
    known = values.compressed()
    low, high = np.percentile(known, [1, 99]) if known.size else (0.0, 1.0)
    vmin = float(low) if panel.vmin is None else panel.vmin
    vmax = float(high) if panel.vmax is None else panel.vmax
    return vmin, (vmax if vmax > vmin else vmin + 1e-3)


def _draw_path(ax: Axes, xy: NDArray) -> None:
    ax.plot(xy[:, 0], xy[:, 1], color="white", linewidth=2.4)
    ax.plot(xy[:, 0], xy[:, 1], color=ROBOT_COLOR, linewidth=1.2)
    ax.plot(*xy[-1, :2], "o", color=ROBOT_COLOR, markeredgecolor="white", markersize=5)


def _label_outer(axes, columns: int) -> None:
    for k, ax in enumerate(axes):
        if k % columns == 0:
            ax.set_ylabel("y, map frame [m]")
        if k + columns >= len(axes):
            ax.set_xlabel("x, map frame [m]")
            ax.tick_params(labelbottom=True)
